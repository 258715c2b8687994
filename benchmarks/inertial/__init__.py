"""What a gyroscope beside the camera is worth: vibration, planes, few points, stamps, cost."""
