"""Simulated and recorded data, and how far an estimate is from the truth."""
