"""What a gyroscope beside the camera is worth: vibration, few points, stamps, cost."""
