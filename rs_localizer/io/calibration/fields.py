"""Calibrations as a mapping with the names that programs usually give: ROS, OpenCV, own JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "mtx")
_DISTORTION = (
    *("distortion_coefficients", "Distortion_Coefficients", "dist_coeffs", "distCoeffs"),
    *("dist_coeff", "distortion", "dist", "D"),
)
_WIDTH = ("image_width", "image_Width", "width", "w")
_HEIGHT = ("image_height", "image_Height", "height", "h")
_SIZE = ("image_size", "imageSize", "img_size", "resolution", "size")
# Coefficients by their own names, in OpenCV's order.
_NAMED = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_RATIONAL = 8  # coefficients and more
# Other names of the models.
_MODELS = {
    "fisheye": DistortionModel.EQUIDISTANT,
    "opencv_fisheye": DistortionModel.EQUIDISTANT,
    "radtan": DistortionModel.PLUMB_BOB,
    "pinhole": DistortionModel.PLUMB_BOB,
    "none": DistortionModel.PLUMB_BOB,
}


def looks_like_fields(tree: dict[str, Any]) -> bool:
    """Whether a mapping has a camera matrix, or focal lengths."""
    return any(name in tree for name in (*_MATRIX, "fx"))


def camera_of_fields(tree: dict[str, Any]) -> Camera:
    """The camera.

    Raises:
        ValueError, KeyError, TypeError: when something is missing or impossible.
    """
    width, height = _size(tree)
    D = _distortion(tree)
    return Camera(
        width=width, height=height, K=_matrix(tree), D=D, distortion_model=_model(tree, len(D))
    )


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
            raise ValueError(
                "it does not say for which size of images: add image_width and image_height"
            )
        width, height = _values(both).tolist()
    if width is None or height is None:
        raise KeyError((_WIDTH if width is None else _HEIGHT)[0])
    return int(width), int(height)


def _matrix(tree: dict[str, Any]) -> Array:
    item = _first(tree, _MATRIX)
    if item is not None:
        return _values(item).reshape(3, 3)
    fx, cx, cy = (float(tree[name]) for name in ("fx", "cx", "cy"))
    fy = float(tree.get("fy", fx))
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _distortion(tree: dict[str, Any]) -> Array:
    item = _first(tree, _DISTORTION)
    if item is not None:
        return _values(item)
    given = [name in tree for name in _NAMED]
    if not any(given):
        return np.zeros(0)
    last = len(given) - given[::-1].index(True)
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
