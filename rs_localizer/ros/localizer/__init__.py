"""The node ``rs_localizer``."""
