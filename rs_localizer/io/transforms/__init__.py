"""Rigid transforms between named frames."""
