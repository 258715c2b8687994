# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo -> Camera."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera, DistortionModel, Roi
from rs_localizer.io.messages import MessageError, frame_id


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a CameraInfo says, by value: equal calibrations compare equal."""

    frame: str  # the camera's optical frame
    width: int
    height: int
    K: tuple[float, ...]  # 9, row by row
    D: tuple[float, ...]
    distortion_model: str
    binning: tuple[int, int]
    roi: Roi | None

    def camera(self, readout_time: float, scan_direction: str) -> Camera:
        """The camera with what CameraInfo does not know: how its shutter moves.

        Raises:
            MessageError: for a calibration that no camera can have, saying what was found.
        """
        try:
            return Camera(
                width=self.width,
                height=self.height,
                K=np.reshape(self.K, (3, 3)),
                D=np.array(self.D),
                distortion_model=self.distortion_model,
                readout_time=readout_time,
                scan_direction=scan_direction,
                binning=self.binning,
                roi=self.roi,
            )
        except ValueError as error:
            raise MessageError(str(error)) from error


def read_camera_info(message: Any) -> Calibration:
    """Read a CameraInfo of ROS 2 (``k``, ``d``) or ROS 1 (``K``, ``D``).

    Binning 0 means 1, and a region of interest of zeros the whole image, as the message says.

    Raises:
        MessageError: for an uncalibrated or impossible camera, saying what was found.
    """
    frame = frame_id(message, "the camera's optical frame")
    ros1 = hasattr(message, "K")
    K = tuple(float(value) for value in (message.K if ros1 else message.k))
    D = tuple(float(value) for value in (message.D if ros1 else message.d))
    width, height = int(message.width), int(message.height)
    if width == 0 or height == 0:
        raise MessageError(f"the image size must be given, found {width} x {height}")
    if len(K) != 9:
        raise MessageError(f"K must have 9 values, found {len(K)}")
    if K[0] == 0.0:
        raise MessageError("the camera is not calibrated: K[0] is 0")
    binning = (int(message.binning_x) or 1, int(message.binning_y) or 1)
    if binning[0] > width or binning[1] > height:
        raise MessageError(
            f"binning of {binning[0]} x {binning[1]} leaves nothing of an image of "
            f"{width} x {height}"
        )
    return Calibration(
        frame=frame,
        width=width,
        height=height,
        K=K,
        D=D,
        distortion_model=_distortion_model(str(message.distortion_model), D),
        binning=binning,
        roi=_roi(message.roi, width, height),
    )


def _distortion_model(name: str, D: tuple[float, ...]) -> str:
    if not name and not any(D):
        return DistortionModel.PLUMB_BOB.value  # drivers of ideal and simulated cameras say nothing
    if name not in tuple(DistortionModel):
        raise MessageError(
            f"distortion_model must be one of {', '.join(DistortionModel)}; found {name!r}"
        )
    return name


def _roi(roi: Any, width: int, height: int) -> Roi | None:
    region = Roi(int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height))
    if region == Roi(0, 0, 0, 0):
        return None
    if (
        min(region.width, region.height) < 1
        or region.x_offset + region.width > width
        or region.y_offset + region.height > height
    ):
        raise MessageError(
            f"the region of interest, {region.width} x {region.height} at ({region.x_offset}, "
            f"{region.y_offset}), does not lie in the image of {width} x {height}"
        )
    return region
