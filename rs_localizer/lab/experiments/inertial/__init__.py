"""What a gyroscope beside the camera is worth: vibration, planes, few points, its stamps, its cost."""
