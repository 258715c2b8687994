"""Geometry, camera and estimation; imports NumPy, Numba and OpenCV, never ROS."""
