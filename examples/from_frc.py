# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of FRC teams -> files of this project: PhotonVision's calibration, WPILib's field.

    python examples/from_frc.py config.json camera.json
    python examples/from_frc.py field.json field.yaml

The first result is for ``--camera``, the second for ``--map``. A field's file does not have the
side of its tags.
"""

import json
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation
from script import run

SIDE = 0.1651  # m, of the black square of a field's tags
# WPILib's x points out of the paper; a print's z does.
TAG_FROM_PRINT = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])


def camera(calibration: dict[str, Any]) -> dict[str, Any]:
    """Return the lens of a calibration by PhotonVision as ``K``, ``D``, ``width``, ``height``."""
    lens = {"K": calibration["cameraIntrinsics"], "D": calibration["distCoeffs"]}
    return lens | calibration["resolution"]


def marker_map(field: dict[str, Any]) -> dict[str, Any]:
    """Return a field of WPILib as a map of markers."""
    markers = []
    for tag in field["tags"]:
        place, rotation = tag["pose"]["translation"], tag["pose"]["rotation"]["quaternion"]
        print_in_map = Rotation.from_quat([rotation[axis] for axis in "XYZW"]) * TAG_FROM_PRINT
        markers.append({
            "family": "apriltag_36h11", "id": tag["ID"], "size": SIDE,
            "position": [place[axis] for axis in "xyz"],
            "quaternion": print_in_map.as_quat().tolist(),
        })  # fmt: skip
    return {"map_frame": "map", "markers": markers}


def main(source: str, out: str) -> None:
    """Write the file that belongs to the source."""
    read = json.loads(Path(source).read_text(encoding="utf-8"))
    made = marker_map(read) if "tags" in read else camera(read)
    Path(out).write_text(json.dumps(made, indent=1), encoding="utf-8")
    print(f"{out}: {len(made['markers'])} tags" if "tags" in read else f"{out}: a camera")


if __name__ == "__main__":
    run(main, "config.json camera.json, or: field.json field.yaml")
