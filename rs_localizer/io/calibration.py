"""Calibration files: those of ROS' camera_calibration and of BoofCV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.io.yaml_text import YamlError, load_yaml


class CalibrationError(ValueError):
    """A calibration file that cannot be used; the message names the file and the fault."""


def read_calibration(path: Path | str) -> Camera:
    """Camera of a YAML file of ROS' camera_calibration, or of BoofCV (pinhole models).

    The readout time is in neither and left at 0.

    Raises:
        CalibrationError: for anything else, saying what was found.
    """
    path = Path(path)
    try:
        tree = load_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {error.strerror}") from error
    except (YamlError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path} is no YAML file: {' '.join(str(error).split())}") from error
    keys = set(tree) if isinstance(tree, dict) else set()
    for key, reader in (("camera_matrix", _ros), ("pinhole", _boofcv)):
        if key in keys:
            try:
                return reader(tree)
            except (KeyError, TypeError, ValueError) as error:
                fault = f"no {error}" if isinstance(error, KeyError) else str(error)
                raise CalibrationError(f"{path} is no usable calibration: {fault}") from error
    raise CalibrationError(
        f"{path} is no calibration: expected a camera_matrix (ROS) or a pinhole (BoofCV), found "
        f"{', '.join(sorted(map(str, keys))) or 'neither'}"
    )


def _ros(tree: dict[str, Any]) -> Camera:
    return Camera(
        width=int(tree["image_width"]),
        height=int(tree["image_height"]),
        K=np.array(tree["camera_matrix"]["data"], np.float64).reshape(3, 3),
        D=np.array(tree["distortion_coefficients"]["data"], np.float64),
        distortion_model=tree["distortion_model"],
    )


def _boofcv(tree: dict[str, Any]) -> Camera:
    pinhole = tree["pinhole"]
    if pinhole.get("skew", 0.0) != 0.0:
        raise ValueError(f"skew must be 0, found {pinhole['skew']}")
    lens = tree.get("radial_tangential", {})
    radial = [float(value) for value in lens.get("radial") or []]
    if len(radial) > 3:
        raise ValueError(f"at most 3 radial coefficients are supported, found {len(radial)}")
    radial += [0.0] * (3 - len(radial))
    k1, k2, k3 = radial
    return Camera(
        width=int(pinhole["width"]),
        height=int(pinhole["height"]),
        K=np.array(
            [
                [pinhole["fx"], 0.0, pinhole["cx"]],
                [0.0, pinhole["fy"], pinhole["cy"]],
                [0.0, 0.0, 1.0],
            ]
        ),
        D=np.array([k1, k2, float(lens.get("t1", 0.0)), float(lens.get("t2", 0.0)), k3]),
    )


def write_calibration(path: Path, camera: Camera) -> None:
    """Write a camera's lens as ROS' camera_calibration and camera_info_manager do."""
    projection = np.hstack([camera.K, np.zeros((3, 1))])
    matrices = (
        ("camera_matrix", camera.K),
        ("distortion_coefficients", camera.D[None]),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", projection),
    )
    text = f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: camera\n"
    for name, matrix in matrices:
        values = ", ".join(repr(float(value)) for value in matrix.ravel())
        rows, columns = matrix.shape
        text += f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{values}]\n"
        if name == "camera_matrix":
            text += f"distortion_model: {camera.distortion_model}\n"
    path.write_text(text, encoding="utf-8")
