# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What gsplat needs to train with a rolling shutter: poses at the first and the last row.

``viewmats.npy`` and ``viewmats_rs.npy`` (n,4,4) are ``camera_from_world`` at the first and at the
last exposed row of the image (``rasterization`` interpolates between them), ``Ks.npy`` (n,3,3) the
intrinsics with the corner of the first pixel at 0, 0, ``names.txt`` the images, ``shutter.txt`` the
name of ``RollingShutterType``. Beside it the same as a text model of COLMAP, with the lens and the
poses of the middle row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.calibration import colmap_parameters
from rs_localizer.io.nerfstudio import pixel_intrinsics


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
    K = np.array([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    np.save(folder / "viewmats.npy", views[:, 0])
    np.save(folder / "viewmats_rs.npy", views[:, 2])
    np.save(folder / "Ks.npy", np.broadcast_to(K, (len(names), 3, 3)))
    width, height = camera.size
    lens = colmap_parameters(camera)
    images = []
    for number, (name, view) in enumerate(zip(names, views[:, 1], strict=True), 1):
        x, y, z, w = Rotation.from_matrix(view[:3, :3]).as_quat(canonical=True)
        images.append(f"{number} {_line([w, x, y, z, *view[:3, 3]])} 1 {name}\n\n")
    for file, text in (
        ("names.txt", "".join(f"{name}\n" for name in names)),
        ("shutter.txt", f"{shutter_type(camera)}\n"),
        ("cameras.txt", f"1 {lens['model']} {width} {height} {_line(lens['params'])}\n"),
        ("images.txt", "".join(images)),
        (
            "points3D.txt",
            "".join(f"{k} {_line(point)} 128 128 128 0\n" for k, point in enumerate(points, 1)),
        ),
    ):
        (folder / file).write_text(text, encoding="utf-8")


def _line(values: Array | list[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
