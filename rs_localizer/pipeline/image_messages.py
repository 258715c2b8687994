"""Messages of images -> gray images, or the reason why not."""

from __future__ import annotations

from typing import Any

from rs_localizer.io.images import Image, read_compressed_image, read_image
from rs_localizer.io.messages import MessageError
from rs_localizer.pipeline.refusal import Refusal


def read(message: Any) -> Image | Refusal:
    """A sensor_msgs/Image or CompressedImage; ``bad_image`` if it cannot be read."""
    try:
        if hasattr(message, "format"):
            return read_compressed_image(message)
        return read_image(message)
    except MessageError as error:
        return Refusal("bad_image", str(error))
