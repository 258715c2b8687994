# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What ``rs_localizer replay RECORDING --parquet FILE`` wrote, for the other examples here."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class Shot:
    """A localized image; poses are map_from_camera (4,4), columns are those of the table."""

    first: np.ndarray  # when its first row is exposed
    middle: np.ndarray
    last: np.ndarray
    columns: dict[str, Any]

    @property
    def stamp_ns(self) -> int:
        """Stamp of the image."""
        return int(self.columns["stamp_ns"])


def read_table(file: str) -> tuple[dict[str, Any], list[Shot]]:
    """The camera of a recording, and its localized images.

    Raises:
        ValueError: when there is none, or they are of several cameras.
    """
    import pyarrow.parquet as pq  # late, so that main() says what is missing

    rows = pq.read_table(file, filters=[("state", "=", "localized")]).to_pylist()
    cameras = {row["camera"] for row in rows}
    if len(cameras) != 1:
        raise ValueError(f"{file} has localized images of {len(cameras)} cameras, not of one")
    ends = ("first_row", "middle_row", "last_row")
    shots = [Shot(*(_matrix(row[name]) for name in ends), row) for row in rows]
    return json.loads(cameras.pop()), shots


def _matrix(values: list[float]) -> np.ndarray:
    """A pose (4,4) of x y z qx qy qz qw."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return pose


def intrinsics(camera: dict[str, Any], corner: float = 0.5) -> np.ndarray:
    """Camera matrix (3,3); ``corner``: where the centre of the first pixel is."""
    K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])
    K[:2, 2] += corner
    return K


def shutter(camera: dict[str, Any]) -> str:
    """As gsplat and NCore call it: ``ROLLING_TOP_TO_BOTTOM`` and so on, ``GLOBAL``."""
    moves = camera["last_row_s"] > camera["first_row_s"]
    return f"ROLLING_{camera['scan_direction']}".upper() if moves else "GLOBAL"


def coefficients(camera: dict[str, Any]) -> dict[str, list[float]]:
    """Of the lens, as gsplat and NCore have them; raises ValueError for one that they have not."""
    D = camera["D"]
    if camera["distortion_model"] == "equidistant":
        return {"radial_coeffs": [*D, 0.0, 0.0, 0.0, 0.0][:4]}
    if camera["distortion_model"] not in ("plumb_bob", "rational_polynomial") or any(D[12:]):
        raise ValueError(f"they have no lens {camera['distortion_model']} of {len(D)} coefficients")
    D = [*D, *[0.0] * 12][:12]  # k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 of OpenCV
    radial, thin_prism = [*D[:2], *D[4:8]], D[8:]
    return {"radial_coeffs": radial, "tangential_coeffs": D[2:4], "thin_prism_coeffs": thin_prism}


def write_images(shots: list[Shot], folder: Path) -> list[str]:
    """Write the compressed images of a bag (``detect --images`` keeps them); a name of each."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    names = {shot.stamp_ns: f"images/{shot.stamp_ns}.jpg" for shot in shots}
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([Path(shots[0].columns["recording"])], default_typestore=store) as bag:
        kind = "sensor_msgs/msg/CompressedImage"
        topics = [item for item in bag.connections if item.msgtype == kind]
        for connection, _, data in bag.messages(topics) if topics else ():
            message: Any = bag.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if stamp in names:
                png = bytes(message.data[:4]) == b"\x89PNG"
                names[stamp] = f"images/{stamp}.{'png' if png else 'jpg'}"
                (folder / names[stamp]).write_bytes(bytes(message.data))
    return list(names.values())
