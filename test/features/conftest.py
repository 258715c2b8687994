# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures whose points are known."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

SIZE = (400, 300)
FINE = 4  # rays along a pixel


@pytest.fixture(scope="session")
def texture() -> Any:
    """Discs, boxes and letters of all sizes (1200, 1600)."""
    rng = np.random.default_rng(7)
    picture = np.full((1200, 1600), 128, np.uint8)
    for size in np.sort(np.exp(rng.uniform(np.log(8), np.log(300), 500)))[::-1]:
        x, y = (int(value) for value in rng.uniform((0, 0), (1600, 1200)))
        grey, kind = int(rng.integers(10, 246)), rng.integers(3)
        if kind == 0:
            box = cv2.boxPoints(((x, y), (size, 0.6 * size), float(rng.uniform(0, 90))))
            cv2.fillPoly(picture, [np.rint(box).astype(np.int32)], grey, cv2.LINE_AA)
        elif kind == 1:
            cv2.circle(picture, (x, y), int(size / 2), grey, -1, cv2.LINE_AA)
        else:
            letter = chr(int(rng.integers(65, 91)))
            cv2.putText(picture, letter, (x, y), 0, size / 22, grey, int(size / 9), cv2.LINE_AA)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


@pytest.fixture(scope="session")
def look(texture) -> Callable[[float, float, tuple[float, float]], tuple[Any, Any]]:
    """An image (300,400) of the texture, and the texels (3,3) of its pixels."""

    def look(angle: float, scale: float, shift: tuple[float, float]) -> tuple[Any, Any]:
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        middle = np.array([[1, 0, shift[0] - 199.5], [0, 1, shift[1] - 149.5], [0, 0, 1]])
        texels = np.array([[c, -s, 800], [s, c, 600], [0, 0, 1]]) @ middle
        half = (1 / FINE - 1) / 2
        fine = np.array([[1 / FINE, 0, half], [0, 1 / FINE, half], [0, 0, 1]])
        size = (SIZE[0] * FINE, SIZE[1] * FINE)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        large = cv2.warpPerspective(texture.astype(np.float32), texels @ fine, size, flags=flags)
        image = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)
        noise = np.random.default_rng(3).normal(0.0, 1.0, image.shape)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8), texels

    return look


@pytest.fixture(scope="session")
def blobs() -> tuple[Any, Any]:
    """An image of round blobs of four sizes, and their middles (n,2)."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[30:300:48, 30:400:48]
    middles = np.column_stack([u.ravel(), v.ravel()]) + rng.uniform(-0.5, 0.5, (u.size, 2))
    y, x = np.mgrid[:300, :400]
    image = np.full((300, 400), 40.0)
    for (px, py), width in zip(middles, np.resize([1.5, 2.5, 4.0, 6.0], u.size), strict=True):
        image += 150.0 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * width**2))
    return np.rint(image).astype(np.uint8), middles
