"""The nodes that look at images: ``marker_detector`` and ``feature_detector``."""
