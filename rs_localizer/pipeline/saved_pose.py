# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The last pose of a robot in a file, from which ``map -> odom`` begins at the next start."""

import json
from pathlib import Path

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.atomic_files import atomic_files
from rs_localizer.io.transforms import Transform
from rs_localizer.pipeline.given_pose import GivenPose

PERIOD = 10.0
"""So often it is written, in s."""
# While nobody looked, a robot may have been moved as far as a click in RViz is uncertain: m, rad.
_MOVED = np.diag(np.repeat((0.5, 0.26), 3)) ** 2
_ORTHONORMAL = 1e-6


def save_pose(file: Path, map_frame: str, map_from_body: Transform, covariance: Array) -> None:
    """Write a pose; the last one stays if the disk is full (:class:`.OutputError`)."""
    text = json.dumps({
        "map_frame": map_frame,
        "position": map_from_body.translation.tolist(),
        "rotation": map_from_body.rotation.tolist(),
        "covariance": covariance.tolist(),
    }, indent=1)  # fmt: skip
    with atomic_files(file) as (part,):
        part.write_text(text, encoding="utf-8")


def load_pose(file: Path) -> GivenPose | None:
    """Load the pose of a file, as a click now; None if there is no file yet.

    Raises:
        ValueError: for a file that holds something else, saying what.
    """
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
        position, rotation, covariance = (
            np.array(said[name], float) for name in ("position", "rotation", "covariance")
        )
        frame = str(said["map_frame"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"saved_pose_file {file} holds no pose: {error!r}") from error
    shapes = position.shape, rotation.shape, covariance.shape
    if shapes != ((3,), (3, 3), (6, 6)) or not all(
        np.isfinite(it).all() for it in (position, rotation, covariance)
    ):
        raise ValueError(f"saved_pose_file {file} holds no pose: numbers of shapes {shapes}")
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() < _ORTHONORMAL
    if not turned or np.linalg.eigvalsh(covariance).min() < -_ORTHONORMAL:
        raise ValueError(f"saved_pose_file {file} holds no rotation or no covariance")
    return GivenPose(0, frame, "", Transform(rotation, position), covariance + _MOVED)
