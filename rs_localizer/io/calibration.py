# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other programs -> Camera.

Read are YAML of ROS' camera_calibration and of BoofCV, YAML and XML of OpenCV's FileStorage,
Kalibr's camchain, COLMAP's ``cameras.txt``, and JSON (or plain YAML) with the usual names. Of a
file of several cameras, the wanted one's name stands behind a ``#``: ``camchain.yaml#cam1``.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.io.yaml_text import YamlError, check_tree, file_faults, load_yaml

# OpenCV writes "%YAML:1.0" where YAML has "%YAML 1.0", and a tag of its own before matrices, which
# are plain mappings of rows, cols, dt and data.
_DIRECTIVE = re.compile(r"\A\ufeff?%YAML[: ][0-9.]+\s*\n")
_TAG = re.compile(r"!!opencv[-_a-z]*")
# XML may define names that stand for ever longer text; OpenCV defines none.
_FORBIDDEN = "<!ENTITY"


def _load_tree(text: str) -> Any:
    """Mappings, lists and plain values of a file's text; YamlError for any other."""
    start = text.lstrip()[:1]
    if start == "<":
        return _load_xml(text)
    if start == "{":
        try:
            tree = json.loads(text)
        except (ValueError, RecursionError):
            return load_yaml(text)  # flow style, and its message if that fails, too
        check_tree(tree)
        return tree
    return load_yaml(_TAG.sub("", _DIRECTIVE.sub("", text)))


T = TypeVar("T")


def _choose(cameras: Mapping[str, T], name: str | None) -> T:
    """The only camera of a file, or the one that is named."""
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if not cameras:
        raise ValueError("it has no camera")
    if name is None or name not in cameras:
        names = ", ".join(cameras)
        raise ValueError(
            f"it has the cameras {names}: choose one with #{next(iter(cameras))} behind the file"
        )
    return cameras[name]


def _load_xml(text: str) -> Any:
    if _FORBIDDEN in text:
        raise YamlError("the XML defines entities")
    try:
        root = ElementTree.fromstring(text)
        return {item.tag: _value(item) for item in root}
    except RecursionError:
        raise YamlError("the XML nests too deep") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise YamlError(f"the XML cannot be read: {error}") from error


def _value(item: ElementTree.Element) -> Any:
    if len(item):
        return {part.tag: _value(part) for part in item}
    words = (item.text or "").split()
    values = [_number(word) for word in words]
    return values[0] if len(values) == 1 and item.tag != "data" else values


def _number(word: str) -> Any:
    try:
        return int(word)
    except ValueError:
        pass
    try:
        return float(word)
    except ValueError:
        return word


# Parameters of each model behind its size, in the order of the models' numbers in COLMAP's binary
# files; f stands for both focal lengths. Names of coefficients are those of OpenCV, whose order is
# k1 k2 p1 p2 k3 k4 k5 k6 (fisheye: k1 k2 k3 k4).
_COLMAP_MODELS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f cx cy", "plumb_bob"),
    "PINHOLE": ("fx fy cx cy", "plumb_bob"),
    "SIMPLE_RADIAL": ("f cx cy k1", "plumb_bob"),
    "RADIAL": ("f cx cy k1 k2", "plumb_bob"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "plumb_bob"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "rational_polynomial"),
}
_ORDER = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
_LINE = re.compile(r"^\s*(\d+)\s+([A-Z][A-Z_]+)((?:\s+[-+.\deE]+)+)\s*$", re.MULTILINE)
# COLMAP has the corner of the first pixel at 0, 0; here that is its centre.
_HALF = 0.5


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """The camera matrix (3,3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _is_colmap(text: str) -> bool:
    """Whether the first line that is no comment is one of ``cameras.txt``."""
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    return _LINE.match(next(lines, "")) is not None


def colmap_camera(text: str, chosen: str | None) -> Camera:
    """The camera with the number ``chosen``, or the only one.

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
    values = dict(zip(names.split(), map(float, words[2:]), strict=True))
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    D = [values.get(name, 0.0) for name in _ORDER[distortion]]
    K = pinhole_matrix(fx, fy, values["cx"] - _HALF, values["cy"] - _HALF)
    return Camera(int(words[0]), int(words[1]), K, np.array(D if any(D) else []), distortion)


def colmap_line(number: int, model: int, width: int, height: int, parameters: Array) -> str:
    """A camera of COLMAP's binary files as a line of its text files.

    Raises:
        ValueError: for a model that is not supported.
    """
    names = list(_COLMAP_MODELS)
    if not 0 <= model < len(names):
        raise ValueError(f"model must be one of {', '.join(names)}; found COLMAP's number {model}")
    values = " ".join(repr(float(value)) for value in parameters)
    return f"{number} {names[model]} {width} {height} {values}"


def pixel_intrinsics(camera: Camera) -> tuple[Array, Array]:
    """Focal lengths (2,) and centre (2,) in px of the delivered image; 0, 0 is its first corner."""
    roi, binning = camera.roi, np.array(camera.binning, float)
    offset = np.zeros(2) if roi is None else np.array([roi.x_offset, roi.y_offset], float)
    return np.diag(camera.K)[:2] / binning, (camera.K[:2, 2] - offset) / binning + _HALF


def colmap_parameters(camera: Camera) -> dict[str, Any]:
    """``model`` and ``params`` that COLMAP knows a camera's delivered images by.

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


_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "mtx")
_DISTORTION = (
    *("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs"),
    *("dist_coeff", "distortion", "dist", "D"),
)
_WIDTH = ("image_width", "image_Width", "width", "w")
_HEIGHT = ("image_height", "image_Height", "height", "h")
_SIZE = ("image_size", "imageSize", "img_size", "resolution", "size")
_NAMED = _ORDER["rational_polynomial"]
_RATIONAL = 8  # coefficients and more
# Other names of the models.
_MODELS = {
    "fisheye": DistortionModel.EQUIDISTANT,
    "opencv_fisheye": DistortionModel.EQUIDISTANT,
    "radtan": DistortionModel.PLUMB_BOB,
    "pinhole": DistortionModel.PLUMB_BOB,
    "none": DistortionModel.PLUMB_BOB,
    "double_sphere": DistortionModel.DOUBLE_SPHERE,
}


def _has_fields(tree: dict[str, Any]) -> bool:
    """Whether a mapping has a camera matrix, or focal lengths."""
    return any(name in tree for name in (*_MATRIX, "fx"))


def _of_fields(tree: dict[str, Any]) -> Camera:
    width, height = _size(tree)
    D = _distortion(tree)
    return Camera(width, height, _matrix(tree), D, _model(tree, len(D)))


def _first(tree: dict[str, Any], names: tuple[str, ...]) -> Any:
    return next((tree[name] for name in names if name in tree), None)


def _values(item: Any) -> Array:
    """Numbers in a list, a list of lists, or the data of a matrix of ROS or OpenCV."""
    if isinstance(item, dict):
        item = item["data"]
    return np.array(item, np.float64).ravel()


def _size(tree: dict[str, Any]) -> tuple[int, int]:
    width, height = _first(tree, _WIDTH), _first(tree, _HEIGHT)
    if width is None and height is None:
        both = _first(tree, _SIZE)
        if both is None:
            raise ValueError("it has no image size: add image_width and image_height")
        width, height = _values(both).tolist()
    if width is None or height is None:
        raise KeyError((_WIDTH if width is None else _HEIGHT)[0])
    return int(width), int(height)


def _matrix(tree: dict[str, Any]) -> Array:
    item = _first(tree, _MATRIX)
    if item is not None:
        return _values(item).reshape(3, 3)
    fx, cx, cy = (float(tree[name]) for name in ("fx", "cx", "cy"))
    return pinhole_matrix(fx, float(tree.get("fy", fx)), cx, cy)


def _distortion(tree: dict[str, Any]) -> Array:
    item = _first(tree, _DISTORTION)
    if item is not None:
        return _values(item)
    present = [name in tree for name in _NAMED]
    if not any(present):
        if _first(tree, _MATRIX) is not None:  # which writers have before the coefficients
            raise ValueError(
                "it has a camera matrix and no distortion coefficients: is it cut off? A lens "
                "without distortion says so: distortion_coefficients: {data: []}"
            )
        return np.zeros(0)
    last = len(present) - present[::-1].index(True)
    count = 4 if last <= 4 else 5 if last == 5 else _RATIONAL
    return np.array([float(tree.get(name, 0.0)) for name in _NAMED[:count]])


def _model(tree: dict[str, Any], count: int) -> str:
    name = tree.get("distortion_model") or tree.get("camera_model") or tree.get("model")
    if tree.get("fisheye_model"):  # of OpenCV's calibration example
        return DistortionModel.EQUIDISTANT
    if name is not None:
        name = str(name).lower()
        if name == "pinhole" and count >= _RATIONAL:
            return DistortionModel.RATIONAL_POLYNOMIAL
        return _MODELS.get(name, name)
    # Without a name, OpenCV's own model: its first coefficients mean the same in all lengths.
    rational = count >= _RATIONAL
    return DistortionModel.RATIONAL_POLYNOMIAL if rational else DistortionModel.PLUMB_BOB


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
    with calibration_faults(path, "YAML, JSON or XML", "not a usable calibration"):
        text = path.read_text(encoding="utf-8")
        camera = _camera(text, chosen)
    if camera is None:
        raise CalibrationError(
            f"{path} is not a calibration: expected a {CALIBRATION_KINDS}; {_fields_in_words(text)}"
        )
    x, y = camera.K[:2, 2]
    if not (0.0 < x < camera.width and 0.0 < y < camera.height):
        raise CalibrationError(
            f"{path} is not a usable calibration: its principal point ({x:g}, {y:g}) lies outside "
            f"its image of {camera.width}x{camera.height}: are width and height exchanged, or of "
            "another resolution?"
        )
    return camera


@contextlib.contextmanager
def calibration_faults(path: Path, kind: str, unusable: str) -> Iterator[None]:
    """Faults within ``with`` of a file, and of what it says, name the file."""
    with file_faults(path, CalibrationError, kind):
        try:
            yield
        except (YamlError, UnicodeDecodeError):
            raise
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            fault = f"no {error}" if isinstance(error, KeyError) else str(error)
            raise CalibrationError(f"{path} is {unusable}: {fault}") from error


def _split(path: Path) -> tuple[Path, str | None]:
    match = _CHOICE.fullmatch(str(path))
    if match is None or path.exists():
        return path, None
    return Path(match[1]), match[2]


def _camera(text: str, chosen: str | None) -> Camera | None:
    if _is_colmap(text):
        return colmap_camera(text, chosen)
    tree = _load_tree(text)
    if not isinstance(tree, dict):
        return None
    cameras = {name: item for name, item in tree.items() if _is_kalibr(item)}
    if cameras:
        return kalibr_camera(_choose(cameras, chosen))
    if chosen is not None:
        raise ValueError(f"it has no camera {chosen!r} to choose")
    readers: tuple[tuple[bool, Callable[[dict[str, Any]], Camera]], ...] = (
        (_is_kalibr(tree), kalibr_camera),
        ("pinhole" in tree, _boofcv),
        (_has_fields(tree), _of_fields),
    )
    return next((reader(tree) for fits, reader in readers if fits), None)


def _fields_in_words(text: str) -> str:
    try:
        tree = _load_tree(text)
    except YamlError:
        tree = None
    keys = sorted(map(str, tree)) if isinstance(tree, dict) else []
    return f"found {', '.join(keys[:8]) or 'neither'}"


# Kalibr's names of lenses, for pinholes; the others stand as camera_model.
_KALIBR_LENSES = {
    "radtan": DistortionModel.PLUMB_BOB,
    "equidistant": DistortionModel.EQUIDISTANT,
    "none": DistortionModel.PLUMB_BOB,
}
_KALIBR_SPHERES = (str(DistortionModel.EUCM), str(DistortionModel.DOUBLE_SPHERE))


def _is_kalibr(tree: Any) -> bool:
    return isinstance(tree, dict) and {"camera_model", "intrinsics", "resolution"} <= set(tree)


def kalibr_camera(tree: dict[str, Any]) -> Camera:
    """The lens of one camera of a camchain.

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
    behind = [] if name == "none" else tree["distortion_coeffs"]
    width, height = tree["resolution"]
    lens = _KALIBR_LENSES[name] if kind == "pinhole" else kind
    D = np.array([*front, *behind], np.float64)
    return Camera(int(width), int(height), pinhole_matrix(fx, fy, cx, cy), D, lens)


def kalibr_fields(camera: Camera) -> dict[str, Any]:
    """What Kalibr's camchain says of a camera's lens, by its names.

    Raises:
        ValueError: for a lens that it has no name for, or a binned or cropped image.
    """
    model, D = DistortionModel(camera.distortion_model), camera.D.tolist()
    if camera.roi is not None or camera.binning != (1, 1):
        raise ValueError("a camchain knows neither binning nor regions of the sensor")
    sphere = str(model) in _KALIBR_SPHERES
    names = {lens: name for name, lens in _KALIBR_LENSES.items() if name != "none"}
    if (model not in names and not sphere) or (model == DistortionModel.PLUMB_BOB and any(D[4:])):
        raise ValueError(f"Kalibr has no lens {model} with {len(D)} coefficients")
    intrinsics = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
    plain = sphere or len(D) == 0
    return {
        "camera_model": str(model) if sphere else "pinhole",
        "intrinsics": [float(value) for value in (*(D if sphere else ()), *intrinsics)],
        "distortion_model": "none" if plain else names[model],
        "distortion_coeffs": [] if plain else D[:4],
        "resolution": [camera.width, camera.height],
    }


def _boofcv(tree: dict[str, Any]) -> Camera:
    pinhole = tree["pinhole"]
    if pinhole.get("skew", 0.0) != 0.0:
        raise ValueError(f"skew must be 0, found {pinhole['skew']}")
    lens = tree.get("radial_tangential", {})
    if not lens and tree.get("model") != "pinhole":
        raise ValueError("it has no radial_tangential: is it cut off?")
    radial = [float(value) for value in lens.get("radial") or []]
    if len(radial) > 3:
        raise ValueError(f"at most 3 radial coefficients are supported, found {len(radial)}")
    k1, k2, k3 = radial + [0.0] * (3 - len(radial))
    D = np.array([k1, k2, float(lens.get("t1", 0.0)), float(lens.get("t2", 0.0)), k3])
    K = pinhole_matrix(*(pinhole[name] for name in ("fx", "fy", "cx", "cy")))
    return Camera(int(pinhole["width"]), int(pinhole["height"]), K, D)


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
