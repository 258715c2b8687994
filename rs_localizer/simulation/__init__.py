"""Simulated frames, rendered images, an IMU, their truth and their recordings."""
