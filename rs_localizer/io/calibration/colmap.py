"""Cameras of COLMAP's ``cameras.txt``."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.io.calibration.text import choose

# Parameters of each model behind its size; f stands for both focal lengths. Names of coefficients
# are those of OpenCV, whose order is k1 k2 p1 p2 k3 k4 k5 k6 (fisheye: k1 k2 k3 k4).
_MODELS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f cx cy", "plumb_bob"),
    "PINHOLE": ("fx fy cx cy", "plumb_bob"),
    "SIMPLE_RADIAL": ("f cx cy k1", "plumb_bob"),
    "RADIAL": ("f cx cy k1 k2", "plumb_bob"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "plumb_bob"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "rational_polynomial"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "equidistant"),
}
_ORDER = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
_LINE = re.compile(r"^\s*(\d+)\s+([A-Z][A-Z_]+)((?:\s+[-+.\deE]+)+)\s*$", re.MULTILINE)
# COLMAP has the corner of the first pixel at 0, 0; here that is its centre.
_HALF = 0.5


def is_colmap(text: str) -> bool:
    """Whether the first line that is no comment is one of ``cameras.txt``."""
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    return _LINE.match(next(lines, "")) is not None


def colmap_camera(text: str, chosen: str | None) -> Camera:
    """The camera with the number ``chosen``, or the only one.

    Raises:
        ValueError: when there are several, or for a model that is not supported.
    """
    found = {match[1]: (match[2], match[3].split()) for match in _LINE.finditer(text)}
    model, words = choose(found, chosen)
    if model not in _MODELS:
        raise ValueError(f"model must be one of {', '.join(_MODELS)}; found {model}")
    names, distortion = _MODELS[model]
    if len(words) != 2 + len(names.split()):
        raise ValueError(f"{model} has width, height, {names}; found {' '.join(words)}")
    values = dict(zip(names.split(), map(float, words[2:]), strict=True))
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    D = [values.get(name, 0.0) for name in _ORDER[distortion]]
    return Camera(
        width=int(words[0]),
        height=int(words[1]),
        K=np.array(
            [[fx, 0.0, values["cx"] - _HALF], [0.0, fy, values["cy"] - _HALF], [0.0, 0.0, 1.0]]
        ),
        D=np.array(D if any(D) else []),
        distortion_model=distortion,
    )


def colmap_parameters(camera: Camera) -> dict[str, Any]:
    """``model`` and ``params`` that COLMAP knows a camera's delivered images by.

    Raises:
        ValueError: for coefficients that no model of COLMAP has.
    """
    distortion = str(camera.distortion_model)
    order, D = _ORDER[distortion], camera.D.tolist()
    if len(D) > len(order):
        raise ValueError(
            f"COLMAP knows {len(order)} coefficients of {distortion}, the lens has {len(D)}"
        )
    offset = np.zeros(2) if camera.roi is None else (camera.roi.x_offset, camera.roi.y_offset)
    binning = np.array(camera.binning, float)
    fx, fy = (np.diag(camera.K)[:2] / binning).tolist()
    cx, cy = ((camera.K[:2, 2] - offset) / binning + _HALF).tolist()
    values = dict(zip(order, D, strict=False)) | {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    model = {"equidistant": "OPENCV_FISHEYE", "plumb_bob": "OPENCV"}.get(distortion, "FULL_OPENCV")
    if model == "OPENCV" and values.get("k3"):
        model = "FULL_OPENCV"
    names = _MODELS[model][0].split()
    return {"model": model, "params": [values.get(name, 0.0) for name in names]}
