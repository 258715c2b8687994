"""Minimal solvers for the absolute pose of a rolling-shutter camera."""
