"""Simulated frames, their truth, and their recordings."""
