# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.load.changes``: what it costs a live node when a setting is changed.

A hand-held camera, 30 images a second that wait for no answer. Every parameter that a running node
lets be set is set to another value, and back ten frames later. Counted are frames
without a pose among the ten after the first change, and among the ten before.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistWithCovarianceStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from benchmarks.load.frames import CAMERA, messages
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import make_camera_info
from rs_localizer.ros.graph.live import LiveNode
from rs_localizer.settings import NODE_NAME, Setting, settings

_POINTS, _RATE = 120, 30.0
_FRAMES, _SETTLING = 10, 5
_LATE = 1.0  # s after the last frame, from which a pose counts as lost
# Moves the stamps of the poses, by which they are told apart here.
_LEFT_OUT = "pose_time"
_SETTINGS: dict[str, Any] = {"readout_time": CAMERA.readout_time}


def another(setting: Setting) -> Any:
    """A value beside the default; None: there is none to be tried."""
    value = setting.default
    if isinstance(value, bool):
        return not value
    if setting.choices:
        return next(choice for choice in setting.choices if choice != value)
    if not isinstance(value, int | float):
        return None
    least = -np.inf if setting.minimum is None else setting.minimum
    most = np.inf if setting.maximum is None else setting.maximum
    step = 1 if isinstance(value, int) else max(0.1 * abs(value), 1e-3)
    tried = (type(value)(value + step), type(value)(value - step))
    return next((one for one in tried if least <= one <= most), None)


class Session:
    """A live node, and the frames that it is sent at the camera's rate."""

    def __init__(self, node: LiveNode, count: int) -> None:
        self._node, self._frame = node, 0
        self._clouds = messages(_POINTS, 0.2, _RATE, count)
        self._info = make_camera_info(CAMERA, 0)
        self._deviations: dict[int, float] = {}  # deg/s of the turn rate
        twist = f"{node.namespace}/{NODE_NAME}/twist_with_covariance"
        node._node.create_subscription(
            TwistWithCovarianceStamped, twist, self._take, QoSProfile(depth=_FRAMES)
        )
        service = f"{node.namespace}/{NODE_NAME}/set_parameters"
        self._client = node._node.create_client(SetParameters, service)

    def _take(self, message: TwistWithCovarianceStamped) -> None:
        angular = np.reshape(message.twist.covariance, (6, 6))[3:, 3:]
        time_ns = stamp_ns(message) - self._node._delay_ns
        self._deviations[time_ns] = float(np.degrees(np.sqrt(np.trace(angular))))

    def send(self, count: int) -> tuple[int, float]:
        """Frames without a pose among so many, and the largest deviation of their turn rates."""
        clouds = self._clouds[self._frame : self._frame + count]
        due = time.monotonic()
        for cloud in clouds:
            self._node.send(self._info, cloud)
            due += 1.0 / _RATE
            while (left := due - time.monotonic()) > 0.0:
                self._node._executor.spin_once(timeout_sec=left)
        self._frame += count

        def lost() -> int:
            return sum(stamp_ns(cloud) not in self._node._poses for cloud in clouds)

        self._node._until(lambda: not lost() or time.monotonic() > due + _LATE)
        known = [self._deviations.get(stamp_ns(cloud), np.nan) for cloud in clouds]
        return lost(), float(np.nanmax([*known, 0.0]))

    def set(self, name: str, value: Any) -> Any:
        """Ask for a parameter to be set; a future of the answer."""
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        return self._client.call_async(request)

    def refusal(self, future: Any) -> str:
        """Why it was not set, or nothing."""
        self._node._until(future.done)
        (result,) = future.result().results
        return "" if result.successful else str(result.reason)


def main() -> int:
    argparse.ArgumentParser(
        prog="python -m benchmarks.load.changes", description=__doc__
    ).parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 100 + 1)
    changes = {
        name: value
        for name, one in settings().items()
        if not (one.read_only or one.fixed or name == _LEFT_OUT)
        and (value := another(one)) is not None
    }
    print("lost of ten frames, and the largest deviation of their turn rates (deg/s)")
    print(f"{'set':44} lost before  lost after  deviation before  after")
    with (
        tempfile.TemporaryDirectory() as place,
        LiveNode(_SETTINGS, Path(place) / "log", 0) as node,
    ):
        node.wait(lambda line: None)
        count = (len(changes) + 2) * (2 * _FRAMES + _SETTLING)
        session = Session(node, count)
        session.send(_FRAMES)
        for name, value in changes.items():
            before = session.send(_FRAMES)
            default = _SETTINGS.get(name, settings()[name].default)
            answer = session.set(name, value)
            after = session.send(_FRAMES)
            refused = session.refusal(answer)
            figures = f"{before[0]:12}{after[0]:12}{before[1]:18.2f}{after[1]:7.2f}"
            print(f"{f'{name}: {value}':44}{refused or figures}", flush=True)
            session.refusal(session.set(name, default))
            session.send(_SETTLING)
    return 0


if __name__ == "__main__":
    sys.exit(main())
