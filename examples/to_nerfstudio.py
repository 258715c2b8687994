# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A table of replay -> nerfstudio's ``transforms.json``, with velocities and the rolling shutter.

    rs_localizer replay seen --params seen/parameters.yaml --smooth --parquet seen.parquet
    python examples/to_nerfstudio.py seen.parquet scene

The fields beside nerfstudio's own are those of *Gaussian Splatting on the Move* (Seiskari et al.,
ECCV 2024): row ``y`` of ``h`` is exposed ``(y / h - 1 / 2) rolling_shutter_time`` after the moment
of ``transform_matrix``; velocities are m/s and rad/s in the camera axes of OpenGL.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from read_table import Shot, intrinsics, read_table, shutter, write_images
from scipy.spatial.transform import Rotation
from script import run

# OpenGL's camera looks along -z with y up.
OPENGL = np.diag([1.0, -1.0, -1.0])
# Names of lenses and of their coefficients, in our order.
LENSES = {
    "plumb_bob": ("OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    "equidistant": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}


def frame(shot: Shot, name: str, seconds: float) -> dict[str, Any]:
    """An image; ``seconds`` from its first row to its last."""
    pose = shot.middle.copy()
    pose[:3, :3] = pose[:3, :3] @ OPENGL
    told: dict[str, Any] = {"file_path": name, "transform_matrix": pose.tolist()}
    if seconds > 0.0:  # one turn and one way from the first row to the last
        turn = Rotation.from_matrix(shot.first[:3, :3].T @ shot.last[:3, :3]).as_rotvec()
        way = shot.middle[:3, :3].T @ (shot.last[:3, 3] - shot.first[:3, 3])
        told["camera_angular_velocity"] = (OPENGL @ turn / seconds).tolist()
        told["camera_linear_velocity"] = (OPENGL @ way / seconds).tolist()
    return told


def transforms(camera: dict[str, Any], shots: list[Shot], names: list[str]) -> dict[str, Any]:
    """What the file holds.

    Raises:
        ValueError: for a lens or a shutter that it has no words for.
    """
    if camera["distortion_model"] not in LENSES:
        raise ValueError(f"transforms.json has no lens {camera['distortion_model']}")
    if shutter(camera) not in ("GLOBAL", "ROLLING_TOP_TO_BOTTOM"):
        raise ValueError(
            f"transforms.json only has shutters from top to bottom, not {camera['scan_direction']}"
        )
    model, coefficients = LENSES[camera["distortion_model"]]
    K, seconds = intrinsics(camera), camera["last_row_s"] - camera["first_row_s"]
    return {
        "camera_model": model, "w": camera["width"], "h": camera["height"],
        "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
        **dict.fromkeys(coefficients, 0.0), **dict(zip(coefficients, camera["D"], strict=False)),
        "rolling_shutter_time": seconds * camera["height"] / (camera["height"] - 1),
        "exposure_time": 0.0,  # of a row, s: fill in yours
        "frames": [frame(*each, seconds) for each in zip(shots, names, strict=True)],
    }  # fmt: skip


def main(table: str, out: str) -> None:
    """Write the folder."""
    camera, shots = read_table(table)
    told = transforms(camera, shots, write_images(shots, Path(out)))
    (Path(out) / "transforms.json").write_text(json.dumps(told, indent=1))
    print(f"{out}: {len(shots)} images")


if __name__ == "__main__":
    run(main, "TABLE.parquet OUT    (the table: rs_localizer replay --parquet)")
