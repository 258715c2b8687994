"""Features of images: keypoints with descriptors, by OpenCV."""
