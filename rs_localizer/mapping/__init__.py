"""Maps of landmarks from images."""
