# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses and velocities for neural reconstruction with a rolling shutter: nerfstudio, gsplat, NCore.

What each file and field is: docs/integrations.md. The fields of nerfstudio's ``transforms.json``
are those of *Gaussian Splatting on the Move* (Seiskari et al., ECCV 2024; its code converts to the
same): the row ``y`` of ``h`` is exposed ``(y / h - 1 / 2) rolling_shutter_time`` after the moment
of ``transform_matrix``, which is the middle of the image. gsplat and NCore interpolate between the
poses at the first and at the last exposed row; NCore's own package makes a sequence of
``ncore.json``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.calibration import pinhole_matrix, pixel_intrinsics
from rs_localizer.io.maps.colmap import ModelImage, Points, write_model

# Axes of OpenGL's camera, which looks along -z with y up, in ours.
_OPENGL = np.diag([1.0, -1.0, -1.0])
# Names of cameras and of their coefficients, in our order.
_MODELS = {
    DistortionModel.PLUMB_BOB: ("OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    DistortionModel.EQUIDISTANT: ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}


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


def transforms(camera: Camera, views: Sequence[View], exposure: float = 0.0) -> dict[str, Any]:
    """What ``transforms.json`` holds.

    Args:
        camera: of all views.
        views: the images.
        exposure: of a row, s; 0: not known.

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
        "exposure_time": exposure,
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


def exposed_rows(camera: Camera) -> tuple[float, float]:
    """Row times of the first and of the last exposed row of the delivered image."""
    width, height = camera.size
    times = camera.row_time(np.array([[0.0, 0.0], [width - 1.0, height - 1.0]]))
    return float(times.min()), float(times.max())


def shutter_type(camera: Camera) -> str:
    """As gsplat and NCore call it: ``ROLLING_TOP_TO_BOTTOM`` and so on, ``GLOBAL``."""
    return f"ROLLING_{camera.scan_direction}".upper() if camera.readout_time > 0.0 else "GLOBAL"


def write_gsplat(
    folder: Path, camera: Camera, names: list[str], poses: Array, points: Array
) -> None:
    """Write the files into a folder that is there.

    Args:
        folder: where to.
        camera: of all images.
        names: (n) of the images.
        poses: (n,3,4,4) map_from_camera at the first, the middle and the last row.
        points: (m,3) of the map.
    """
    views = np.linalg.inv(poses)
    focal, centre = pixel_intrinsics(camera)
    K = pinhole_matrix(*focal, *centre)
    np.save(folder / "viewmats.npy", views[:, 0])
    np.save(folder / "viewmats_rs.npy", views[:, 2])
    np.save(folder / "Ks.npy", np.broadcast_to(K, (len(names), 3, 3)))
    for name, values in (_coefficients(camera) if np.any(camera.D) else {}).items():
        np.save(folder / f"{name}.npy", np.tile(values, (len(names), 1)))
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = {
        name: ModelImage(number, 1, view[:3, :3], view[:3, 3], *nothing)
        for number, (name, view) in enumerate(zip(names, views[:, 1], strict=True), 1)
    }
    count = len(points)
    grey = np.full((count, 3), 128, np.uint8)
    described = Points(np.arange(1, count + 1), points, grey, np.zeros(count))
    write_model(folder, camera, images, described)
    (folder / "names.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    (folder / "shutter.txt").write_text(f"{shutter_type(camera)}\n", encoding="utf-8")


_COEFFICIENTS = 12  # of OpenCV's polynomials: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4


def _coefficients(camera: Camera) -> dict[str, list[float]]:
    """Of the lens, as gsplat and NCore have them.

    Raises:
        ValueError: for a lens that they do not have.
    """
    if camera.distortion_model == DistortionModel.EQUIDISTANT:
        return {"radial_coeffs": [*camera.D.tolist(), *[0.0] * 4][:4]}
    if not camera.law.is_polynomial or np.any(camera.D[_COEFFICIENTS:]):
        raise ValueError(
            f"gsplat and NCore have no lens {camera.distortion_model} of {len(camera.D)} "
            "coefficients"
        )
    D = [*camera.D.tolist(), *[0.0] * _COEFFICIENTS][:_COEFFICIENTS]
    return {
        "radial_coeffs": [*D[:2], *D[4:8]],
        "tangential_coeffs": D[2:4],
        "thin_prism_coeffs": D[8:],
    }


def sequence(camera: Camera, names: list[str], stamps_ns: IntArray, poses: Array) -> dict[str, Any]:
    """What ``ncore.json`` holds.

    Args:
        camera: of all images.
        names: (n) of the image files.
        stamps_ns: (n,2) exposure of the first and of the last row.
        poses: (n,2,4,4) map_from_camera then.
    """
    focal, centre = pixel_intrinsics(camera)
    model: dict[str, Any] = {
        "resolution": list(camera.size),
        "shutter_type": shutter_type(camera),
        "external_distortion_parameters": None,
        "principal_point": centre.tolist(),
        "focal_length": focal.tolist(),
    }
    if camera.distortion_model == DistortionModel.EQUIDISTANT:
        # All over the image: its corners may show nothing.
        places = np.meshgrid(*(np.linspace(0.0, size - 1.0, 99) for size in camera.size))
        ahead = camera.bearings(np.column_stack([each.ravel() for each in places]))[:, 2]
        model |= {"camera_model_type": "opencv-fisheye"}
        model["max_angle"] = float(np.arccos(np.nanmin(ahead)))
    else:
        model |= {"camera_model_type": "opencv-pinhole"}
    model |= _coefficients(camera)
    frames = [
        {
            "file_path": name,
            "timestamps_us": [round(stamp / 1000) for stamp in stamps],
            "T_sensor_world": pair.tolist(),
        }
        for name, stamps, pair in zip(names, stamps_ns.tolist(), poses, strict=True)
    ]
    return {"camera_model_parameters": model, "frames": frames}
