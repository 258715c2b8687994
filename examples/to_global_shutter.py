# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images as a global shutter would have taken them at their middle row, in the same lens.

    rs_localizer replay seen --params seen/parameters.yaml --smooth --parquet seen.parquet
    python examples/to_global_shutter.py seen.parquet global 1.5

For programs that know no rolling shutter. The last word is the distance (m) of what the images
show; without it everything is far away, and only the turn of the camera is undone. The motion
between the first and the last row is taken for one at constant velocities.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from read_table import Shot, intrinsics, read_table, write_images
from scipy.spatial.transform import Rotation, Slerp
from script import run

import rs_localizer as rsl

# Between points so far apart (px) the displacement is interpolated: it is as smooth as the lens.
STEP = 8


def camera_of(told: dict[str, Any]) -> rsl.Camera:
    """The camera of the delivered image."""
    return rsl.Camera(
        told["width"], told["height"], intrinsics(told, 0.0), told["D"], told["distortion_model"],
        readout_time=told["last_row_s"] - told["first_row_s"],
        scan_direction=told["scan_direction"],
    )  # fmt: skip


def rectified(camera: rsl.Camera, image: np.ndarray, shot: Shot, depth: float) -> np.ndarray:
    """The image (h,w) or (h,w,3) of a global shutter; black where no row has seen what is there.

    Args:
        camera: that took it.
        image: as it was taken.
        shot: its poses.
        depth: m from the camera of all that it shows; infinite: far away.
    """
    height, width = image.shape[:2]
    columns, rows = (np.unique([*range(0, size, STEP), size - 1]) for size in (width, height))
    grid = np.stack(np.meshgrid(columns, rows), axis=2).reshape(-1, 2).astype(float)
    rays = np.column_stack([camera.rays(grid), np.ones(len(grid))]) @ shot.middle[:3, :3].T
    turns = Slerp([-0.5, 0.5], Rotation.from_matrix([shot.first[:3, :3], shot.last[:3, :3]]))
    pixels = grid
    for _ in range(5):  # the row decides the pose, the pose the row
        tau = np.clip(np.nan_to_num(camera.row_time(pixels)), -0.5, 0.5)
        way = np.outer(tau, shot.last[:3, 3] - shot.first[:3, 3]) / depth
        pixels = camera.project(turns(tau).inv().apply(rays - way))
    moved = (pixels - grid).reshape(len(rows), len(columns), 2).astype(np.float32)
    across = np.interp(np.arange(width), columns, np.arange(len(columns))).astype(np.float32)
    down = np.interp(np.arange(height), rows, np.arange(len(rows))).astype(np.float32)
    moved = cv2.remap(moved, *np.meshgrid(across, down), cv2.INTER_LINEAR)
    x = moved[..., 0] + np.arange(width, dtype=np.float32)
    y = moved[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    return cv2.remap(image, np.nan_to_num(x, nan=-1e6), np.nan_to_num(y, nan=-1e6), cv2.INTER_CUBIC)


def main(table: str, out: str, depth: str = "inf") -> None:
    """Write the images."""
    told, shots = read_table(table)
    folder, camera, count = Path(out), camera_of(told), 0
    for shot, name in zip(shots, write_images(shots, folder), strict=True):
        image = cv2.imread(str(folder / name))
        if image is not None:
            made = rectified(camera, image, shot, float(depth))
            cv2.imwrite(str(folder / name), made)
            count += 1
    if not count:
        raise ValueError(f"the recording of {table} has no images: detect --images keeps them")
    print(f"{out}: {count} images")


if __name__ == "__main__":
    run(main, "TABLE.parquet OUT [METRES]    (the table: rs_localizer replay --parquet)")
