"""Marker maps of other programs: a format per file, read and written."""
