"""What localizes, built of a calibration and settings; they change together or not at all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from rs_localizer import matching
from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate
from rs_localizer.io.camera_info import Calibration
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.imu import inertial_settings
from rs_localizer.pipeline.pose_at_time import middle_row_ns, pose_at, twist_at
from rs_localizer.pipeline.single_frames import SingleFrames
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import Tracker

ANY_CALIBRATION = Calibration(
    "camera", 640, 480, (500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0), (), "plumb_bob",
    (1, 1), None,
)  # fmt: skip
"""Stands in until the first camera_info: kernels are compiled and settings checked before it."""
# Something to publish before there is anything.
_STILL = Estimate(
    rotation=np.eye(3),
    translation=np.zeros(3),
    angular_velocity=np.zeros(3),
    linear_velocity=np.zeros(3),
    inliers=np.zeros(0, dtype=np.bool_),
    residuals=np.zeros(0),
    joint_covariance=np.zeros((18, 18)),
    global_shutter_inliers=0,
    iterations=0,
)


@dataclass(frozen=True, slots=True)
class Method:
    """Camera, localizer and what leads it from frame to frame, which belong together."""

    calibration: Calibration
    config: NodeConfig
    camera: Camera
    localizer: Localizer
    frames: Tracker | SingleFrames

    @classmethod
    def of(cls, calibration: Calibration, config: NodeConfig) -> Self:
        """The method of these settings.

        Raises:
            ValueError: for settings that the localizer refuses.
        """
        camera = calibration.camera(config.readout_time, config.scan_direction)
        localizer = Localizer(camera, config)
        estimates_motion = find_solver(config.solver).rolling_shutter
        timed = config.readout_time > 0.0 and estimates_motion
        inertial = inertial_settings(config) if timed else None
        frames: Tracker | SingleFrames
        if timed and config.tracking:
            frames = Tracker(localizer, inertial)
        else:
            # Without a readout time frames cannot predict each other; map and lens stay the same.
            remembers = config.tracking and estimates_motion
            frames = SingleFrames(localizer, inertial, remembers)
        return cls(calibration, config, camera, localizer, frames)

    @property
    def tracker(self) -> Tracker | None:
        """None: no frame predicts the next."""
        return self.frames if isinstance(self.frames, Tracker) else None

    def middle_row_ns(self, stamp_ns: int) -> int:
        """When the middle row of the image with this stamp was exposed."""
        return middle_row_ns(self.config, self.camera, stamp_ns)

    def warm_up(self) -> None:
        """Compile all that it needs, from points to messages."""
        self.localizer.warm_up()
        so3.quaternion(pose_at(_STILL, 0.5).rotation.copy())
        twist_at(_STILL, 0.5, 1.0)
        so3.log(np.eye(3))
        so3.exp_many(np.zeros((1, 3)))  # of the watch over the readout time
        matching.warm_up()
