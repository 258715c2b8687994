# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of nerfstudio, with what reconstructions need that know the rolling shutter.

Fields as *Gaussian Splatting on the Move* (Seiskari et al., ECCV 2024; its code converts to the
same) reads them beside nerfstudio's own: ``camera_linear_velocity`` and ``camera_angular_velocity``
of each frame (m/s and rad/s, in the camera's axes), ``rolling_shutter_time`` and
``exposure_time`` (s). The row ``y`` of ``h`` is exposed ``(y / h - 1 / 2) rolling_shutter_time``
after the moment of ``transform_matrix``, which is the middle of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.core.scanning import ScanDirection

# Axes of OpenGL's camera, which looks along -z with y up, in ours.
_OPENGL = np.diag([1.0, -1.0, -1.0])
# Names of cameras and of their coefficients, in our order.
_MODELS = {
    DistortionModel.PLUMB_BOB: ("OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    DistortionModel.EQUIDISTANT: ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
# nerfstudio has the corner of the first pixel at 0, 0, as COLMAP.
_HALF = 0.5


class NerfstudioError(ValueError):
    """A camera that the format cannot say; the text says why."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """An image and the camera at the moment of its middle row."""

    file: str  # relative to transforms.json
    rotation: Array  # (3,3) map_from_camera
    position: Array  # (3,) m
    linear: Array | None  # (3,) m/s, camera axes; None: unknown
    angular: Array | None  # (3,) rad/s, camera axes


def middle_of_image(camera: Camera) -> float:
    """The row time of the middle of the delivered image."""
    _, height = camera.size
    return float(camera.row_time(np.array([[0.0, (height - 1) / 2]]))[0])


def pixel_intrinsics(camera: Camera) -> tuple[Array, Array]:
    """Focal lengths (2,) and principal point (2,) in pixels of the delivered image, the corner of
    whose first pixel is at 0, 0.
    """
    binning = np.array(camera.binning, float)
    offset = np.zeros(2)
    if camera.roi is not None:
        offset[:] = camera.roi.x_offset, camera.roi.y_offset
    return np.diag(camera.K)[:2] / binning, (camera.K[:2, 2] - offset) / binning + _HALF


def transforms(camera: Camera, views: Sequence[View]) -> dict[str, Any]:
    """What ``transforms.json`` holds.

    Raises:
        NerfstudioError: for a lens or a shutter that it has no words for.
    """
    model = DistortionModel(camera.distortion_model)
    if model not in _MODELS:
        raise NerfstudioError(
            f"transforms.json has no lens {model}: calibrate it as {' or '.join(_MODELS)}"
        )
    if camera.readout_time > 0.0 and camera.scan_direction != ScanDirection.TOP_TO_BOTTOM:
        raise NerfstudioError(
            "transforms.json only has shutters that move from top to bottom, this one moves "
            f"{camera.scan_direction}: turn the images"
        )
    name, coefficients = _MODELS[model]
    width, height = camera.size
    focal, centre = pixel_intrinsics(camera)
    lens = dict.fromkeys(coefficients, 0.0) | dict(
        zip(coefficients, camera.D.tolist(), strict=False)
    )
    seconds = camera.readout_time * float(camera.row_time_gradient[1]) * height
    return {
        "camera_model": name,
        "w": width, "h": height,
        "fl_x": float(focal[0]), "fl_y": float(focal[1]),
        "cx": float(centre[0]), "cy": float(centre[1]),
        **lens,
        "rolling_shutter_time": seconds,
        "exposure_time": 0.0,
        "frames": [_frame(view) for view in views],
    }  # fmt: skip


def _frame(view: View) -> dict[str, Any]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = view.rotation @ _OPENGL, view.position
    frame: dict[str, Any] = {"file_path": view.file, "transform_matrix": matrix.tolist()}
    if view.linear is not None and view.angular is not None:
        frame["camera_linear_velocity"] = (_OPENGL @ view.linear).tolist()
        frame["camera_angular_velocity"] = (_OPENGL @ view.angular).tolist()
    return frame
