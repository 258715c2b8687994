# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of textured planes as a moving rolling-shutter camera takes them.

Every line of pixels (a row, or a column if the shutter moves sideways) is seen from the true pose
at its own time; the lens distortion bends the rays of the pixels, never their time.
"""

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.simd.jit import kernel
from rs_localizer.io.video import Image
from rs_localizer.tools.simulation.simulated_frames import middle_stamp
from rs_localizer.tools.simulation.simulated_settings import ImageSettings
from rs_localizer.tools.simulation.true_motion import TrueMotion, TrueState
from rs_localizer.tools.simulation.walls import TexturedPlane


def pyramids(planes: Sequence[TexturedPlane]) -> tuple[Image, NDArray[np.int64]]:
    """The pictures of several planes with all their reductions, for the kernel.

    Returns texels (n,) and levels (planes, levels, 3): ``levels[p, l]`` is where level ``l`` of
    picture ``p`` begins, its width and height; each level averages two by two texels of the one
    before. Pictures with fewer levels repeat their last.
    """
    reduced = [_reductions(plane.texture) for plane in planes]
    depth = max(len(images) for images in reduced)
    levels = np.zeros((len(planes), depth, 3), np.int64)
    start = 0
    for p, images in enumerate(reduced):
        for level, image in enumerate(images):
            levels[p, level:] = start, image.shape[1], image.shape[0]
            start += image.size
    return np.concatenate([image.ravel() for images in reduced for image in images]), levels


def _reductions(texture: Image) -> list[Image]:
    images = [np.ascontiguousarray(texture)]
    while min(images[-1].shape) > 1:
        image = images[-1]
        # Texels stay squares of 2^level: an odd last row or column stands for a pair.
        even = np.pad(image, [(0, size % 2) for size in image.shape], mode="edge")
        half = cv2.resize(
            even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
        images.append(np.asarray(half, np.uint8).reshape(even.shape[0] // 2, even.shape[1] // 2))
    return images


# Walls that meet in an edge overlap by this many texels, so that no ray slips between them.
_OVERLAP = np.float32(0.02)
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@kernel
def render_lines(
    rays: Any,
    homographies: Any,
    texels: Any,
    levels: Any,
    background: Any,
    first: int,
    last: int,
    image: Any,
) -> None:
    """Mean grey level of each pixel in the lines from ``first`` to before ``last``.

    Every pixel averages its rays over all instants of its exposure. A ray takes the nearest
    plane that it meets within its picture, between the two reductions whose texels are nearest in
    size to the step between rays: the larger of the two steps, so that nothing aliases.

    Args:
        rays: (lines, pixels, 4, 2) float32, bearings of two by two rays in each pixel, the
            second beside the first and the third below it; a NaN meets nothing.
        homographies: (lines, instants, planes, 3, 3) float32, see TexturedPlane.homographies.
        texels, levels: see pyramids.
        background: float32, grey level of what meets no plane.
        image: (lines, pixels) float32, written.
    """
    pixels = rays.shape[1]
    instants, planes = homographies.shape[1], homographies.shape[2]
    # One instant takes all four rays. Several take two of a diagonal in turns: the mean of either
    # is the middle of the pixel, so that nothing is shifted.
    count = 4 if instants == 1 else 2
    deepest = np.float32(levels.shape[1] - 1)
    for line in range(first, last):
        for pixel in range(pixels):
            total = _ZERO
            known_plane, level, between = -1, 0, _ZERO
            for instant in range(instants):
                for j in range(count):
                    k = j if count == 4 else (3 * j if instant % 2 == 0 else 1 + j)
                    a, b = rays[line, pixel, k, 0], rays[line, pixel, k, 1]
                    nearest, plane, s, t = _ZERO, -1, _ZERO, _ZERO
                    for p in range(planes):
                        h = homographies[line, instant, p]
                        q = h[2, 0] * a + h[2, 1] * b + h[2, 2]
                        if q > nearest:
                            depth = _ONE / q
                            x = (h[0, 0] * a + h[0, 1] * b + h[0, 2]) * depth
                            y = (h[1, 0] * a + h[1, 1] * b + h[1, 2]) * depth
                            if (
                                x > -_OVERLAP
                                and y > -_OVERLAP
                                and x < levels[p, 0, 1] + _OVERLAP
                                and y < levels[p, 0, 2] + _OVERLAP
                            ):
                                nearest, plane, s, t = q, p, x, y
                    if plane < 0:
                        total += background
                        continue
                    if plane != known_plane:
                        # The steps to the rays on the right and below, in texels.
                        h = homographies[line, instant, plane]
                        largest = _ZERO
                        for other in (1, 2):
                            da = rays[line, pixel, other, 0] - rays[line, pixel, 0, 0]
                            db = rays[line, pixel, other, 1] - rays[line, pixel, 0, 1]
                            dq = h[2, 0] * da + h[2, 1] * db
                            dx = (h[0, 0] * da + h[0, 1] * db - s * dq) / nearest
                            dy = (h[1, 0] * da + h[1, 1] * db - t * dq) / nearest
                            largest = max(largest, dx * dx + dy * dy)
                        fine = _ZERO
                        if largest > _ONE:
                            fine = min(_HALF * np.log2(largest), deepest)
                        level = int(fine)
                        between = fine - np.float32(level)
                        known_plane = plane
                    grey = _bilinear(texels, levels, plane, level, s, t)
                    if between > _ZERO:
                        coarse = _bilinear(
                            texels, levels, plane, min(level + 1, levels.shape[1] - 1), s, t
                        )
                        grey += between * (coarse - grey)
                    total += grey
            image[line, pixel] = total / np.float32(count * instants)


@kernel
def _bilinear(texels: Any, levels: Any, plane: int, level: int, s: Any, t: Any) -> Any:
    """Between the four texels around (s, t), which count in texels of level 0."""
    start, width, height = levels[plane, level, 0], levels[plane, level, 1], levels[plane, level, 2]
    scale = _ONE / np.float32(1 << level)
    x = min(max(s * scale - _HALF, _ZERO), np.float32(width - 1))
    y = min(max(t * scale - _HALF, _ZERO), np.float32(height - 1))
    column, row = int(x), int(y)
    right = min(column + 1, width - 1) - column
    upper = start + row * width + column
    lower = start + min(row + 1, height - 1) * width + column
    fx, fy = x - np.float32(column), y - np.float32(row)
    above = np.float32(texels[upper])
    above += fx * (np.float32(texels[upper + right]) - above)
    below = np.float32(texels[lower])
    below += fx * (np.float32(texels[lower + right]) - below)
    return above + fy * (below - above)


# Where in a pixel its two by two rays go through, along either axis.
_WITHIN = np.array([-0.25, 0.25])
# An exposure is cut into instants between which no point moves by more than this (px) ...
_LONGEST_STEP = 1.0
# ... nor is it cut into more than so many.
_MOST_INSTANTS = 24
# Nothing is expected to be nearer (m) when the steps are estimated.
_NEAREST = 0.5
# Grey level of what meets no plane.
_BACKGROUND = 60.0


class Renderer:
    """Renders one scene with one camera; may be used by several threads at once.

    Args:
        camera: its readout time and scan direction decide when each line is exposed; a readout
            time of 0 exposes all at once.
        planes: the scene.
        settings: default: a perfect sensor.
    """

    def __init__(
        self,
        camera: Camera,
        planes: Sequence[TexturedPlane],
        settings: ImageSettings | None = None,
    ) -> None:
        self.camera = camera
        self.planes = tuple(planes)
        self.settings = settings or ImageSettings()
        self._texels, self._levels = pyramids(planes)
        # Lines of the shutter first: a sideways shutter sees the transposed image.
        self._sideways = camera.row_time_gradient[0] != 0.0
        self._rays = _rays(camera, self._sideways)
        step = camera.row_time_gradient[int(not self._sideways)]
        first = float(camera.row_time(np.zeros((1, 2)))[0])
        self._tau = first + step * np.arange(self._rays.shape[0])

    def image(self, motion: TrueMotion, stamp_ns: int, seed: Sequence[int] = (0,)) -> Image:
        """The image (height, width) whose first row is exposed around ``stamp_ns``.

        Args:
            seed: of the noise.
        """
        camera = self.camera
        middle_ns = middle_stamp(camera, stamp_ns)
        offsets = self._exposure_instants(motion, middle_ns)
        times = self._tau[:, None] * camera.readout_time + offsets
        state = motion.state(middle_ns, times.ravel())
        homographies = np.stack(
            [plane.homographies(state.rotations, state.positions) for plane in self.planes], axis=1
        ).reshape((*times.shape, len(self.planes), 3, 3))
        lines = np.empty(self._rays.shape[:2], np.float32)
        render_lines(
            self._rays, homographies.astype(np.float32), self._texels, self._levels,
            np.float32(_BACKGROUND), 0, len(lines), lines,
        )  # fmt: skip
        image: NDArray[np.float32] = lines.T if self._sideways else lines
        if self.settings.noise > 0.0:
            rng = np.random.default_rng(list(seed))
            image += self.settings.noise * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)

    def _exposure_instants(self, motion: TrueMotion, middle_ns: int) -> Array:
        """Offsets (m,) in s from a row's time, evenly over the exposure."""
        exposure = self.settings.exposure
        if exposure == 0.0:
            return np.zeros(1)
        state = motion.state(middle_ns, np.zeros(1))
        nearest = min(
            abs(float((state.positions[0] - plane.corner) @ plane.normal)) for plane in self.planes
        )
        speed = np.linalg.norm(state.angular[0]) + np.linalg.norm(state.linear[0]) / max(
            nearest, _NEAREST
        )
        travel = float(speed * exposure * self.camera.K[0, 0] / self.camera.binning[0])
        count = min(max(math.ceil(travel / _LONGEST_STEP), 1), _MOST_INSTANTS)
        offsets: Array = exposure * ((np.arange(count) + 0.5) / count - 0.5)
        return offsets


def _rays(camera: Camera, sideways: bool) -> NDArray[np.float32]:
    """Bearings (lines, pixels, rays, 2) float32 of the rays of all pixels."""
    width, height = camera.size
    size, other = (width, height) if sideways else (height, width)
    line, pixel, j, i = np.meshgrid(
        np.arange(size), np.arange(other), _WITHIN, _WITHIN, indexing="ij"
    )
    lines, along = line + j, pixel + i
    x, y = (lines, along) if sideways else (along, lines)
    rays = camera.rays(np.column_stack([x.ravel(), y.ravel()]))
    return rays.astype(np.float32).reshape(size, other, 4, 2)


FORMAT = "jpeg"
"""Format of sensor_msgs/CompressedImage."""
_QUALITY = 95  # its artefacts stay below the noise of a corner
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """One image; ``stamp_ns`` is the exposure of the first row, the middle row follows."""

    stamp_ns: int
    middle_ns: int
    data: bytes  # JPEG
    first_row: TrueState  # one instant: at stamp_ns
    middle_row: TrueState  # one instant: at middle_ns


def rendered_frames(
    renderer: Renderer,
    motion: TrueMotion,
    stamps_ns: Sequence[int],
    seed: int = 0,
) -> Iterator[RenderedFrame]:
    """The frames of a camera along a motion, whose first rows are exposed at ``stamps_ns``.

    Each image has its own noise, from ``seed`` and its place in the list.
    """
    now = np.zeros(1)

    def frame(numbered: tuple[int, int]) -> RenderedFrame:
        index, stamp_ns = numbered
        middle_ns = middle_stamp(renderer.camera, stamp_ns)
        return RenderedFrame(
            stamp_ns=stamp_ns,
            middle_ns=middle_ns,
            data=_jpeg(renderer.image(motion, stamp_ns, (seed, index))),
            first_row=motion.state(stamp_ns, now),
            middle_row=motion.state(middle_ns, now),
        )

    yield from in_order(frame, enumerate(stamps_ns))


def _jpeg(image: Image) -> bytes:
    done, data = cv2.imencode(f".{FORMAT}", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return bytes(data.tobytes())


def in_order(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """``map`` with a thread per core; only a few results wait, however slowly they are taken."""
    workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
    waiting: deque[Future[R]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
