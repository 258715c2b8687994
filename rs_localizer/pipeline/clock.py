"""From stamps to rows and back: ``stamp_offset`` and the readout's first half lie between."""

from __future__ import annotations

from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core.camera import Camera


def middle_row_ns(config: NodeConfig, camera: Camera, stamp_ns: int) -> int:
    """When the middle row of the image with this stamp was exposed."""
    delay = config.stamp_offset - config.readout_time * camera.first_row_time
    return stamp_ns + round(delay * 1e9)


def published_moment(config: NodeConfig, camera: Camera, stamp_ns: int) -> tuple[int, float]:
    """The stamp for which a pose is published, and the row time of that moment."""
    if config.pose_time == PoseTime.MID_FRAME:
        return middle_row_ns(config, camera, stamp_ns), 0.0
    tau = camera.first_row_time
    if config.readout_time > 0.0:
        tau -= config.stamp_offset / config.readout_time
    return stamp_ns, tau
