"""Poses that jump: who filters them has to begin anew, and does not see why.

A pose after a gap, or one that was searched for afresh, is no jump: it is of the same map. A jump
is one that does not follow from the last one, within what both are uncertain by and what a camera
can accelerate: because a mirrored or wrong pose came before, or the map has changed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Localized, Twist

_POSITION, _ROTATION = slice(0, 3), slice(3, 6)
# Squared distance in standard deviations: exceeded once in 10 million (chi-square, 3).
_GATE = 36.0


class Jumps:
    """Counts the jumps of the frames of one camera, in their order.

    Args:
        config: tells the settings that hold now: how fast cameras move and accelerate.
    """

    def __init__(self, config: Callable[[], NodeConfig]) -> None:
        self.count = 0
        self._config = config
        self._last: Localized | None = None

    def add(self, frame: Localized) -> int:
        """The number of jumps up to this frame, with this one."""
        last, self._last = self._last, frame
        if last is not None and self._jumps(last, frame):
            self.count += 1
        return self.count

    def _jumps(self, last: Localized, frame: Localized) -> bool:
        seconds = (frame.stamp_ns - last.stamp_ns) * 1e-9
        if seconds <= 0.0 or frame.map_frame != last.map_frame:
            return True
        config = self._config()
        twist = last.twist or _unknown(config)
        orientation = last.pose.rotation
        way = orientation @ twist.linear * seconds
        turn = orientation @ so3.exp(twist.angular * seconds) @ frame.pose.rotation.T
        steps = (
            frame.pose.position - last.pose.position - way,
            so3.log(np.ascontiguousarray(turn)),
        )
        both = last.pose.covariance + frame.pose.covariance
        accelerations = (config.acceleration.linear, config.acceleration.angular)
        parts = zip(steps, (_POSITION, _ROTATION), accelerations, strict=True)
        return any(
            _distance(
                step,
                both[part, part]
                + seconds**2 * orientation @ twist.covariance[part, part] @ orientation.T
                + (0.5 * acceleration * seconds**2) ** 2 * np.eye(3),
            )
            > _GATE
            for step, part, acceleration in parts
        )


def _unknown(config: NodeConfig) -> Twist:
    """What is known of a velocity that no frame tells: how fast cameras move."""
    prior = config.velocity_prior
    speeds = np.repeat([prior.linear, prior.angular], 3)
    return Twist(linear=np.zeros(3), angular=np.zeros(3), covariance=np.diag(speeds**2))


def _distance(step: Array, covariance: Array) -> float:
    """Squared, in standard deviations."""
    return float(step @ np.linalg.solve(covariance, step))
