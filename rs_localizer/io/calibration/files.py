"""Calibration files of other programs -> Camera.

Read are YAML of ROS' camera_calibration and of BoofCV, YAML and XML of OpenCV's FileStorage,
Kalibr's camchain, COLMAP's ``cameras.txt``, and JSON (or plain YAML) with the usual names. Of a
file of several cameras, the wanted one's name stands behind a ``#``: ``camchain.yaml#cam1``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.io.calibration.colmap import colmap_camera, is_colmap
from rs_localizer.io.calibration.fields import camera_of_fields, looks_like_fields
from rs_localizer.io.calibration.text import choose, load_tree
from rs_localizer.io.yaml_text import YamlError

CALIBRATION_KINDS = (
    "calibration file of ROS' camera_calibration, OpenCV (YAML, XML), Kalibr (camchain), COLMAP "
    "(cameras.txt), BoofCV, or JSON with K, D, width and height"
)
# Who writes FILE#cam1 means a camera in a file; a name of a file may hold the sign, too.
_CHOICE = re.compile(r"(.+)#([^/#]+)")


class CalibrationError(ValueError):
    """A calibration file that cannot be used; the message names the file and the fault."""


def read_calibration(path: Path | str) -> Camera:
    """Camera of a calibration file (see the module), with the readout time left at 0.

    Args:
        path: the file; ``FILE#NAME`` chooses one of several cameras in it.

    Raises:
        CalibrationError: for anything else, saying what was found.
    """
    path, chosen = _split(Path(path))
    try:
        text = path.read_text(encoding="utf-8")
        camera = _camera(text, chosen)
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {error.strerror}") from error
    except (YamlError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"{path} is not a YAML, JSON or XML file: {' '.join(str(error).split())}"
        ) from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        fault = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CalibrationError(f"{path} is not a usable calibration: {fault}") from error
    if camera is None:
        raise CalibrationError(
            f"{path} is not a calibration: expected a {CALIBRATION_KINDS}; {_found(text)}"
        )
    x, y = camera.K[:2, 2]
    if not (0.0 < x < camera.width and 0.0 < y < camera.height):
        raise CalibrationError(
            f"{path} is not a usable calibration: its principal point ({x:g}, {y:g}) lies outside "
            f"its image of {camera.width}x{camera.height}: are width and height exchanged, or of "
            "another resolution?"
        )
    return camera


def _split(path: Path) -> tuple[Path, str | None]:
    match = _CHOICE.fullmatch(str(path))
    if match is None or path.exists():
        return path, None
    return Path(match[1]), match[2]


def _camera(text: str, chosen: str | None) -> Camera | None:
    if is_colmap(text):
        return colmap_camera(text, chosen)
    tree = load_tree(text)
    if not isinstance(tree, dict):
        return None
    cameras = {name: item for name, item in tree.items() if _is_kalibr(item)}
    if cameras:
        return _kalibr(choose(cameras, chosen))
    if chosen is not None:
        raise ValueError(f"it has no camera {chosen!r} to choose")
    readers: tuple[tuple[bool, Callable[[dict[str, Any]], Camera]], ...] = (
        (_is_kalibr(tree), _kalibr),
        ("pinhole" in tree, _boofcv),
        (looks_like_fields(tree), camera_of_fields),
    )
    return next((reader(tree) for fits, reader in readers if fits), None)


def _found(text: str) -> str:
    try:
        tree = load_tree(text)
    except YamlError:
        tree = None
    keys = sorted(map(str, tree)) if isinstance(tree, dict) else []
    return f"found {', '.join(keys[:8]) or 'neither'}"


def _is_kalibr(tree: Any) -> bool:
    return isinstance(tree, dict) and {"camera_model", "intrinsics", "resolution"} <= set(tree)


def _kalibr(tree: dict[str, Any]) -> Camera:
    if tree["camera_model"] != "pinhole":
        raise ValueError(
            f"camera_model must be pinhole, found {tree['camera_model']!r}: calibrate with "
            "pinhole-radtan or, for a wide lens, pinhole-equi"
        )
    models = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
    name = tree.get("distortion_model", "none")
    if name not in models:
        raise ValueError(f"distortion_model must be one of {', '.join(models)}; found {name!r}")
    fx, fy, cx, cy = map(float, tree["intrinsics"])
    width, height = tree["resolution"]
    return Camera(
        width=int(width),
        height=int(height),
        K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        D=np.array([] if name == "none" else tree["distortion_coeffs"], np.float64),
        distortion_model=models[name],
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
