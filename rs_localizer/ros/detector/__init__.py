"""The node ``marker_detector``."""
