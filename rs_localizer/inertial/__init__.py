"""Gyroscope and accelerometer: what turns and shakes the camera while its rows are exposed."""
