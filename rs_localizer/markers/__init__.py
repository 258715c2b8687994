"""Markers and boards: their map, finding them in images, printing and drawing them.

Names are imported from the modules themselves.
"""
