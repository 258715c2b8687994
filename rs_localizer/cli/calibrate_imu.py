# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What ``calibrate --imu`` says and writes."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.trajectory.calibration import Calibration
from rs_localizer.trajectory.imu import ImuRecording, MountFound

# A rotation that TF has otherwise by more than this (degrees), and more than chance, is doubted.
_MOST_TURN, _SIGMAS = 1.0, 4.0
# Who says how the IMU hangs on the camera.
_GIVEN = "TF, or the axes of a video,"
# A scale of the gyroscope that is worth a word.
_LEAST_SCALE = 0.005


def time_offset(found: MountFound, config: NodeConfig) -> float:
    """``imu.time_offset`` (s): the camera's time is its stamp plus ``stamp_offset``."""
    return found.time_offset + config.stamp_offset


def imu_lines(found: Calibration, imu: ImuRecording | None, config: NodeConfig) -> list[str]:
    """Rows of the table, and sentences on what is odd."""
    if imu is None:
        return []
    mount = found.mount
    if mount is None:
        return [f"imu: {found.no_mount}"]
    offset = (
        f"{1e3 * time_offset(mount, config):+.3f} +- {1e3 * mount.time_offset_deviation:.3f} ms"
    )
    turn = Rotation.from_matrix(mount.mount.camera_from_imu).as_quat(canonical=True)
    turn_deviations = np.degrees(mount.rotation_deviations)
    bias, bias_deviations = np.degrees([mount.mount.bias, mount.bias_deviations])
    rows = [
        ("imu.time_offset", offset, mount.time_offset_determined),
        (
            "rotation camera <- imu",
            f"{_numbers(turn, 5)} (x y z w) +- {_numbers(turn_deviations, 3)} deg",
            mount.rotation_determined,
        ),
        (
            "gyroscope bias",
            f"{_numbers(bias, 3)} +- {_numbers(bias_deviations, 3)} deg/s",
            mount.bias_determined,
        ),
        ("gyroscope noise", f"{np.degrees(mount.noise):.3f} deg/s, {mount.samples} samples", True),
    ]
    said = [
        f"{name:26} {text if known else f'not observable: {text}'}" for name, text, known in rows
    ]
    return said + _remarks(mount, imu)


def _numbers(values: Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


def _remarks(found: MountFound, imu: ImuRecording) -> list[str]:
    said = []
    if found.inflation > 1.0:
        said.append(
            f"imu: parts of the recording have different offsets: the deviation is "
            f"{found.inflation:.1f} times that of the noise alone"
        )
    if imu.camera_from_imu is None:
        said.append("imu: TF does not say how it hangs on the camera; the rotation is not checked")
    elif found.rotation_determined:
        off = np.degrees(found.turned_from(imu.camera_from_imu))
        error = float(np.degrees(np.linalg.norm(found.rotation_deviations)))
        if off > max(_MOST_TURN, _SIGMAS * error):
            said.append(f"imu: {_GIVEN} has another rotation, {off:.1f} deg off: is it right?")
        else:
            said.append(f"imu: {_GIVEN} agrees with the rotation to {off:.2f} deg")
    scales, errors = found.mount.shape[:3], found.shape_deviations[:3]
    if np.any(np.abs(scales) > np.maximum(_LEAST_SCALE, _SIGMAS * errors)):
        percent = " ".join(f"{100.0 * scale:+.1f}" for scale in scales)
        said.append(f"imu: the gyroscope's scales are {percent} % off (allowed for)")
    return said


def imu_parameters(found: Calibration, config: NodeConfig) -> str:
    """Lines of the parameters file; none where the offset is not known."""
    if found.mount is None or not found.mount.time_offset_determined:
        return ""
    return f"    imu.time_offset: {time_offset(found.mount, config)!r}\n"
