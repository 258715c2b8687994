# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/CameraInfo -> Camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera, DistortionModel, Roi
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.messages import MessageError, frame_id


@dataclass(frozen=True, slots=True)
class Calibration:
    """Content of a CameraInfo, by value: equal calibrations compare equal."""

    frame: str  # the camera's optical frame
    width: int
    height: int
    K: tuple[float, ...]  # 9, row by row
    D: tuple[float, ...]
    distortion_model: str
    binning: tuple[int, int]
    roi: Roi | None

    def camera(self, readout_time: float, scan_direction: str) -> Camera:
        """Return the camera with the motion of its shutter, which CameraInfo does not have.

        Raises:
            MessageError: for a calibration that no camera can have, saying what was found.
        """
        if self.K[0] == 0.0:
            raise MessageError("the camera is not calibrated: K[0] is 0")
        try:
            return Camera(
                self.width, self.height, np.reshape(self.K, (3, 3)), np.array(self.D),
                self.distortion_model, readout_time, scan_direction, self.binning, self.roi,
            )  # fmt: skip
        except ValueError as error:
            raise MessageError(str(error)) from error

    def with_lens(self, lens: Camera) -> Calibration:
        """Return the calibration of the same image with another lens.

        Raises:
            MessageError: for a lens that is of another image.
        """
        if (lens.width, lens.height) != (self.width, self.height):
            raise MessageError(
                f"camera_file is of an image of {lens.width}x{lens.height}, camera_info of "
                f"{self.width}x{self.height}"
            )
        K, D = tuple(lens.K.ravel().tolist()), tuple(lens.D.tolist())
        return replace(self, K=K, D=D, distortion_model=str(lens.distortion_model))


def read_camera_info(message: Any) -> Calibration:
    """Read a sensor_msgs/CameraInfo.

    Binning 0 means 1, and a region of interest of zeros the whole image, as the message says.

    Raises:
        MessageError: for an impossible camera, saying what was found.
    """
    frame = frame_id(message, "the camera's optical frame")
    K, D = (tuple(map(float, values)) for values in (message.k, message.d))
    width, height = int(message.width), int(message.height)
    if width == 0 or height == 0:
        raise MessageError(f"the image size must be given, found {width} x {height}")
    if len(K) != 9:
        raise MessageError(f"K must have 9 values, found {len(K)}")
    binning = (int(message.binning_x) or 1, int(message.binning_y) or 1)
    if binning[0] > width or binning[1] > height:
        raise MessageError(
            f"binning of {binning[0]} x {binning[1]} leaves nothing of an image of "
            f"{width} x {height}"
        )
    model, D = interpret_lens(str(message.distortion_model), D)
    roi = _roi(message.roi, width, height)
    found = Calibration(frame, width, height, K, D, model, binning, roi)
    if K[0] != 0.0 and (binning != (1, 1) or roi is not None):
        _check_binned(K, (width, height), found)
    return found


# Other names of the models, in drivers and in files.
_NAMES = {
    "fisheye": "equidistant", "opencv_fisheye": "equidistant", "kannala_brandt": "equidistant",
    "kannala_brandt4": "equidistant", "plumb bob": "plumb_bob", "radtan": "plumb_bob",
    "brown_conrady": "plumb_bob", "opencv_standard": "plumb_bob",
    "rational": "rational_polynomial", "double_sphere": str(DistortionModel.DOUBLE_SPHERE),
}  # fmt: skip
_RATIONAL = 8  # coefficients of OpenCV's models and more


def interpret_lens(said: str, D: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Return the model and its coefficients, if name and coefficients can mean one lens only.

    Drivers of ideal and simulated cameras name no model; others fill D with zeros, or write
    OpenCV's coefficients, which mean the same in all lengths, under the name of the shortest.

    Raises:
        MessageError: otherwise, saying what was found.
    """
    used = max((k + 1 for k, value in enumerate(D) if value != 0.0), default=0)
    name = _NAMES.get(said.lower(), said.lower())
    if name in ("", "none", "pinhole", "plumb_bob"):
        if used > 5 and len(D) >= _RATIONAL:
            name = "rational_polynomial"
        elif name == "plumb_bob" or used == 0 or len(D) >= 5:
            name = "plumb_bob"
        else:
            raise MessageError(
                f"distortion_model is {said!r}, and {len(D)} coefficients may be of plumb_bob or "
                "of equidistant: name it"
            )
    if name not in tuple(DistortionModel):
        raise MessageError(
            f"distortion_model must be one of {', '.join(DistortionModel)}; found {said!r}"
        )
    counts = DistortionModel(name).law.counts
    fitting = [count for count in counts if used <= count < len(D)]
    return name, D if len(D) in counts or not fitting else D[: max(fitting)]


# Principal points lie so near the middle, as a share of the image.
_CENTRAL = 0.2


def _check_binned(K: tuple[float, ...], size: tuple[int, int], image: Calibration) -> None:
    """Refuse a K of the delivered image beside a binning or a region, which would count twice."""
    camera = image.camera(0.0, ScanDirection.TOP_TO_BOTTOM)
    centre = np.array([K[2], K[5]])

    def central(extent: tuple[int, int]) -> bool:
        return bool(np.all(np.abs(centre - 0.5 * np.array(extent)) < _CENTRAL * np.array(extent)))

    if camera.size != size and central(camera.size) and not central(size):
        raise MessageError(
            f"K is of the delivered image of {camera.size[0]}x{camera.size[1]}: its principal "
            f"point ({K[2]:g}, {K[5]:g}) lies in the middle of that, not of the {size[0]}x{size[1]}"
            " of the message; give width and height of that image without binning and region, or a "
            "K of all pixels"
        )


def _roi(roi: Any, width: int, height: int) -> Roi | None:
    region = Roi(int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height))
    if region == Roi(0, 0, 0, 0):
        return None
    ends = region.x_offset + region.width, region.y_offset + region.height
    if min(region.width, region.height) < 1 or ends[0] > width or ends[1] > height:
        raise MessageError(
            f"the region of interest, {region.width} x {region.height} at ({region.x_offset}, "
            f"{region.y_offset}), does not lie in the image of {width} x {height}: width and "
            "height are those of all pixels"
        )
    return region
