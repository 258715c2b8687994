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

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.maps.colmap import ModelImage, Points, write_model
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
