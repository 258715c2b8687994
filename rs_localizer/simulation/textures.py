"""Generated pictures: something to look at at every distance, and nobody's copyright."""

from __future__ import annotations

import cv2
import numpy as np

from rs_localizer.io.video import Image

# Shapes per square of this many texels, of all sizes between a few texels and a few hundred.
_SHAPES_PER = 9000
_SMALLEST, _LARGEST = 6.0, 400.0
# Fine grain (standard deviation of a grey level) and its sizes in texels.
_GRAIN = ((1, 6.0), (4, 8.0), (32, 10.0))


def collage(width: int, height: int, rng: np.random.Generator) -> Image:
    """Rectangles, discs and letters of all sizes and greys over each other, with some grain.

    The same generator state gives the same picture (height, width).
    """
    picture = np.full((height, width), 128, np.uint8)
    count = max(20, width * height // _SHAPES_PER)
    # Large ones first, or they would cover the rest.
    sizes = np.sort(np.exp(rng.uniform(np.log(_SMALLEST), np.log(_LARGEST), count)))[::-1]
    for size in sizes.tolist():
        middle = rng.uniform((0.0, 0.0), (width, height))
        _draw_shape(picture, middle.tolist(), size, int(rng.integers(10, 246)), rng)
    grey = picture.astype(np.float32)
    for step, deviation in _GRAIN:
        grain = rng.standard_normal((height // step + 2, width // step + 2)).astype(np.float32)
        grown = cv2.resize(grain, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
        grey += deviation * grown[:height, :width]
    return np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8)


def _draw_shape(
    picture: Image, middle: list[float], size: float, grey: int, rng: np.random.Generator
) -> None:
    x, y = (int(value) for value in middle)
    kind, angle = rng.integers(3), float(rng.uniform(0.0, 180.0))
    if kind == 0:
        extent = (size, size * float(rng.uniform(0.2, 1.0)))
        box = cv2.boxPoints(((x, y), extent, angle))
        cv2.fillPoly(picture, [np.rint(box).astype(np.int32)], grey, cv2.LINE_AA)
    elif kind == 1:
        axes = (max(1, int(0.5 * size)), max(1, int(0.5 * size * rng.uniform(0.4, 1.0))))
        cv2.ellipse(picture, (x, y), axes, angle, 0.0, 360.0, grey, -1, cv2.LINE_AA)
    else:
        letter = chr(int(rng.integers(ord("A"), ord("Z") + 1)))
        cv2.putText(
            picture, letter, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size / 22.0, grey,
            max(1, int(size / 9.0)), cv2.LINE_AA,
        )  # fmt: skip
