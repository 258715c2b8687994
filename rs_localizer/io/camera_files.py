# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other programs -> Camera.

The content of a file tells which program wrote it. Of several cameras in a file one is chosen after
a ``#``: ``camchain.yaml#cam1``.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.io import reading
from rs_localizer.io.camera_info import interpret_lens

# Order of OpenCV's coefficients, by their names.
_ORDER = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
# Names of the parts of a lens in ROS, in OpenCV's programs and in users' files.
_K = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "mtx")
_D = (
    "distortion_coefficients", "Distortion_Coefficients", "distortion_coeffs", "dist_coeffs",
    "distCoeffs", "dist", "D",
)  # fmt: skip
_SIZE = ("image_size", "imageSize", "resolution")
_WIDTH, _HEIGHT = (
    ("image_width", "image_Width", "width"),
    ("image_height", "image_Height", "height"),
)
CALIBRATION_KINDS = (
    "calibration file of ROS' camera_calibration, OpenCV (YAML, JSON), Kalibr (camchain), COLMAP "
    "(cameras.txt), Gyroflow, or JSON with K, D, width and height"
)
# FILE#cam1 is a camera in a file; the name of a file may hold the sign, too.
_CHOICE = re.compile(r"(.+)#([^/#]+)")


class CalibrationError(ValueError):
    """A calibration file that cannot be used; the message names the file and the fault."""


def read_calibration(path: Path | str) -> Camera:
    """Read the camera of a calibration file (see the module); an unknown readout time is 0.

    Args:
        path: the file; ``FILE#NAME`` chooses one of several cameras in it.

    Raises:
        CalibrationError: for anything else, saying what was found.
    """
    path, chosen = Path(path), None
    if (match := _CHOICE.fullmatch(str(path))) is not None and not path.exists():
        path, chosen = Path(match[1]), match[2]
    with calibration_faults(path, "YAML or JSON", "not a usable calibration"):
        camera = _camera(reading.read_text(path, "utf-8-sig"), chosen)
        x, y = camera.K[:2, 2]
        if not (0.0 < x < camera.width and 0.0 < y < camera.height):
            raise ValueError(
                f"its principal point ({x:g}, {y:g}) lies outside its image of {camera.width}x"
                f"{camera.height}: are width and height exchanged, or of another resolution?"
            )
        return camera


@contextlib.contextmanager
def calibration_faults(path: Path, kind: str, unusable: str) -> Iterator[None]:
    """Name the file in faults within the context, of the file and of its content."""
    with reading.file_faults(path, CalibrationError, kind):
        try:
            yield
        except (reading.YamlError, UnicodeDecodeError):
            raise
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            fault = f"no {error}" if isinstance(error, KeyError) else str(error)
            raise CalibrationError(f"{path} is {unusable}: {fault}") from error


def _camera(text: str, chosen: str | None) -> Camera:
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    if _LINE.match(next(lines, "")) is not None:
        return colmap_camera(text, chosen)
    if text.lstrip()[:1] == "<":
        raise reading.YamlError(
            "it is XML, which OpenCV's FileStorage writes as .yaml or .json, too"
        )
    tree = reading.load_yaml(_TAG.sub("", _DIRECTIVE.sub("", text)))
    tree = tree if isinstance(tree, dict) else {}
    blocks = (block for _, block in reading.parameter_blocks(tree) if isinstance(block, dict))
    tree = next((block[reading.LENS] for block in blocks if reading.LENS in block), tree)
    own = {"camera_matrix", "image_width"}  # of one of the cameras of ``calibrate --rig``
    cameras = {
        name: item for name, item in tree.items()
        if isinstance(item, dict) and (own <= set(item) or _is_kalibr(item))
    }  # fmt: skip
    if cameras:
        tree = _choose(cameras, chosen)
    elif chosen is not None:
        raise ValueError(f"it has no camera {chosen!r} to choose")
    if _is_kalibr(tree):
        return kalibr_camera(tree)
    if {"fisheye_params", "calib_dimension"} <= set(tree):
        return _gyroflow_camera(tree)
    if _first(tree, _K) is not None:
        return lens_camera(tree)
    found = ", ".join(sorted(map(str, tree))[:8]) or "nothing"
    raise ValueError(f"expected a {CALIBRATION_KINDS}; found {found}")


def _choose(cameras: Mapping[str, Any], name: str | None) -> Any:
    """Return the only camera of a file, or the one that is named."""
    if not cameras:
        raise ValueError("it has no camera")
    if name is None and len(cameras) == 1:
        (name,) = cameras
    if name is None or name not in cameras:
        raise ValueError(
            f"it has the cameras {', '.join(cameras)}: choose one with #{next(iter(cameras))} "
            "behind the file"
        )
    return cameras[name]


# OpenCV writes "%YAML:1.0" where YAML has "%YAML 1.0", and a tag of its own before matrices, which
# are plain mappings of rows, cols, dt and data.
_DIRECTIVE = re.compile(r"\A%YAML[: ][0-9.]+\s*\n")
_TAG = re.compile(r"!!opencv[-_a-z]*")


def _gyroflow_camera(tree: dict[str, Any]) -> Camera:
    size = tree["calib_dimension"]
    lens = {"width": size["w"], "height": size["h"], "distortion_model": "equidistant"}
    camera = lens_camera(tree["fisheye_params"] | lens)
    seconds = 1e-3 * float(tree.get("frame_readout_time") or 0.0)  # of all rows
    readout_time = seconds * (camera.height - 1) / camera.height
    return replace(camera, readout_time=max(readout_time, 0.0))


def lens_camera(tree: dict[str, Any]) -> Camera:
    """Return the camera of :func:`lens_parameters`, of a file of ROS or OpenCV, or of a user's.

    Raises:
        ValueError, KeyError, TypeError: when something is missing or impossible.
    """
    K, D, size = (_first(tree, names) for names in (_K, _D, _SIZE))
    if K is None:
        raise KeyError("camera_matrix")
    if size is None:
        size = [_first(tree, names) for names in (_WIDTH, _HEIGHT)]
        if size == [None, None]:
            raise ValueError("it has no image size: add image_width and image_height")
        if None in size:
            raise KeyError((_WIDTH, _HEIGHT)[size.index(None)][0])
    if D is None:  # which writers have behind the matrix
        raise ValueError(
            "it has a camera matrix and no distortion coefficients: is it cut off? A lens "
            "without distortion says so: distortion_coefficients: {data: []}"
        )
    width, height = (int(side) for side in _values(size))
    name = str(_first(tree, ("distortion_model", "camera_model")) or "").lower()
    name = "fisheye" if tree.get("fisheye_model") else name  # of OpenCV's example
    # Without a name, OpenCV's own model.
    name = "plumb_bob" if name in ("", "pinhole", "none") else name
    model, coefficients = interpret_lens(name, tuple(_values(D).tolist()))
    return Camera(width, height, _values(K).reshape(3, 3), coefficients, model)


def _first(tree: dict[str, Any], names: tuple[str, ...]) -> Any:
    """Return the value of the first of these names that the tree has; None if it has none."""
    return next((tree[name] for name in names if tree.get(name) is not None), None)


def _values(item: Any) -> Array:
    """Return the numbers of a list, or of a matrix of ROS or OpenCV."""
    return np.array(item["data"] if isinstance(item, dict) else item, np.float64).ravel()


# Parameters of COLMAP's models behind its size; f stands for both focal lengths.
_COLMAP_MODELS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f cx cy", "plumb_bob"),
    "PINHOLE": ("fx fy cx cy", "plumb_bob"),
    "SIMPLE_RADIAL": ("f cx cy k1", "plumb_bob"),
    "RADIAL": ("f cx cy k1 k2", "plumb_bob"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "plumb_bob"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "rational_polynomial"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "equidistant"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "equidistant"),
}
_LINE = re.compile(r"^\s*(\d+)\s+([A-Z][A-Z_]+)((?:\s+[-+.\deE]+)+)\s*$", re.MULTILINE)
# COLMAP has the corner of the first pixel at 0, 0; here that is its centre.
_HALF = 0.5


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return the camera matrix (3,3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def colmap_camera(text: str, chosen: str | None) -> Camera:
    """Return the camera with the number ``chosen``, or the only one.

    Raises:
        ValueError: when there are several, or for a model that is not supported.
    """
    cameras = {match[1]: (match[2], match[3].split()) for match in _LINE.finditer(text)}
    model, words = _choose(cameras, chosen)
    if model not in _COLMAP_MODELS:
        raise ValueError(f"model must be one of {', '.join(_COLMAP_MODELS)}; found {model}")
    names, distortion = _COLMAP_MODELS[model]
    if len(words) != 2 + len(names.split()):
        raise ValueError(f"{model} has width, height, {names}; found {' '.join(words)}")
    width, height, *numbers = words
    values = dict(zip(names.split(), map(float, numbers), strict=True))
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    D = [values.get(name, 0.0) for name in _ORDER[distortion]]
    K = pinhole_matrix(fx, fy, values["cx"] - _HALF, values["cy"] - _HALF)
    return Camera(int(width), int(height), K, np.array(D if any(D) else []), distortion)


def pixel_intrinsics(camera: Camera) -> tuple[Array, Array]:
    """Return focal lengths (2,) and centre (2,), px of the delivered image, corner at 0, 0."""
    roi, binning = camera.roi, np.array(camera.binning, float)
    offset = np.zeros(2) if roi is None else np.array([roi.x_offset, roi.y_offset], float)
    return np.diag(camera.K)[:2] / binning, (camera.K[:2, 2] - offset) / binning + _HALF


def colmap_parameters(camera: Camera) -> dict[str, Any]:
    """Return ``model`` and ``params`` by which COLMAP knows a camera's delivered images.

    Raises:
        ValueError: for coefficients that no model of COLMAP has.
    """
    distortion, D = str(camera.distortion_model), camera.D.tolist()
    if distortion not in _ORDER:
        raise ValueError(f"COLMAP has no lens {distortion}")
    order = _ORDER[distortion]
    if len(D) > len(order):
        raise ValueError(
            f"COLMAP knows {len(order)} coefficients of {distortion}, the lens has {len(D)}"
        )
    intrinsics = np.concatenate(pixel_intrinsics(camera)).tolist()
    values = dict(zip(order, D, strict=False))
    values |= dict(zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True))
    model = {"equidistant": "OPENCV_FISHEYE", "plumb_bob": "OPENCV"}.get(distortion, "FULL_OPENCV")
    if model == "OPENCV" and values.get("k3"):
        model = "FULL_OPENCV"
    names = _COLMAP_MODELS[model][0].split()
    return {"model": model, "params": [values.get(name, 0.0) for name in names]}


# Kalibr's names of lenses, for pinholes; the others stand as camera_model.
_KALIBR_LENSES = ("radtan", "equidistant", "none")
_KALIBR_SPHERES = (str(DistortionModel.EUCM), str(DistortionModel.DOUBLE_SPHERE))


def _is_kalibr(tree: dict[Any, Any]) -> bool:
    return {"camera_model", "intrinsics", "resolution"} <= set(tree)


def kalibr_camera(tree: dict[str, Any]) -> Camera:
    """Return the lens of one camera of a camchain.

    Raises:
        ValueError, KeyError, TypeError: when something is missing or impossible.
    """
    kind, name = tree["camera_model"], tree.get("distortion_model", "none")
    if kind not in ("pinhole", *_KALIBR_SPHERES):
        raise ValueError(
            f"camera_model must be pinhole, {' or '.join(_KALIBR_SPHERES)}, found {kind!r}: "
            "calibrate with pinhole-radtan or, for a wide lens, pinhole-equi, eucm-none or ds-none"
        )
    if name not in (_KALIBR_LENSES if kind == "pinhole" else ("none",)):
        known = ", ".join(_KALIBR_LENSES) if kind == "pinhole" else f"none with {kind}"
        raise ValueError(f"distortion_model must be one of {known}; found {name!r}")
    # Coefficients of eucm and ds stand before the focal lengths.
    *front, fx, fy, cx, cy = map(float, tree["intrinsics"])
    D = np.array([*front, *([] if name == "none" else tree["distortion_coeffs"])], np.float64)
    lens = interpret_lens(name, tuple(D))[0] if kind == "pinhole" else kind
    width, height = map(int, tree["resolution"])
    return Camera(width, height, pinhole_matrix(fx, fy, cx, cy), D, lens)


def lens_parameters(camera: Camera) -> dict[str, Any]:
    """Return ``lens`` of a ROS params file, for :func:`read_calibration`; nodes ignore it."""
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "distortion_model": str(camera.distortion_model),
        "camera_matrix": camera.K.ravel().tolist(),
        # ROS cannot infer the type of an empty list.
        "distortion_coefficients": camera.D.tolist() or [0.0] * camera.law.counts[-1],
    }


def write_calibration(path: Path, camera: Camera) -> None:
    """Write a camera's lens as ROS' camera_calibration and camera_info_manager do."""
    tree = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": "camera",
        "camera_matrix": _matrix(camera.K),
        "distortion_model": str(camera.distortion_model),
        "distortion_coefficients": _matrix(camera.D[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([camera.K, np.zeros((3, 1))])),
    }
    path.write_text(reading.dump_yaml(tree), encoding="utf-8")


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}
