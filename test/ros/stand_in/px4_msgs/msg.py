# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages that take what rclpy's would take."""

import math
from typing import Any

import numpy as np

# PX4-Autopilot, msg/versioned/VehicleOdometry.msg: numbers with their range, vectors with theirs.
_INTEGERS = {
    "timestamp": (0, 2**64 - 1),
    "timestamp_sample": (0, 2**64 - 1),
    "pose_frame": (0, 255),
    "velocity_frame": (0, 255),
    "reset_counter": (0, 255),
    "quality": (-128, 127),
}
_VECTORS = {
    "position": 3,
    "q": 4,
    "velocity": 3,
    "angular_velocity": 3,
    "position_variance": 3,
    "orientation_variance": 3,
    "velocity_variance": 3,
}


class VehicleOdometry:
    """Fields as rosidl_generator_py makes them: integers of Python, arrays of float32."""

    def __init__(self, **fields: Any) -> None:
        for name, value in fields.items():
            if name in _INTEGERS:
                low, high = _INTEGERS[name]
                assert type(value) is int, f"{name} must be of type int"
                assert low <= value <= high, f"{name} must be in [{low}, {high}]"
            else:
                assert isinstance(value, np.ndarray), f"{name} must be an array"
                assert value.dtype == np.float32, f"{name} must be of float32"
                assert value.shape == (_VECTORS[name],), f"{name} has {_VECTORS[name]} elements"
                assert not np.isinf(value).any()
            setattr(self, name, value)
        assert math.isfinite(fields.get("timestamp", 0))
