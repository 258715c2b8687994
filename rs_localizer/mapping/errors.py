"""What keeps images from becoming a map."""

from __future__ import annotations


class MappingError(ValueError):
    """Images that make no map; the message says what was found and what to do."""
