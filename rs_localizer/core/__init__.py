"""Geometry: rotations, camera, shutter and state; imports NumPy, Numba and OpenCV, never ROS."""
