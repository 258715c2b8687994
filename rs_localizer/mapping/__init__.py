"""Maps from images: landmarks and markers refined together with the motion that saw them."""
