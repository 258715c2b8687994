# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of textured planes as a moving rolling-shutter camera takes them.

Every line of pixels (a row, or a column if the shutter moves sideways) is seen from the true pose
at its own time; the lens distortion bends the rays of the pixels, never their time.
"""

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.video import Image
from rs_localizer.tools.simulation.render_kernels import render_lines
from rs_localizer.tools.simulation.simulated_frames import middle_stamp
from rs_localizer.tools.simulation.true_motion import TrueMotion, TrueState
from rs_localizer.tools.simulation.walls import TexturedPlane


@dataclass(frozen=True, slots=True)
class ImageSettings:
    """Faults of the sensor."""

    exposure: float = 0.0  # s that each row is exposed, around its row time; 0: an instant
    noise: float = 0.0  # standard deviation of a grey level (of 255)


def pyramids(planes: Sequence[TexturedPlane]) -> tuple[Image, NDArray[np.int64]]:
    """Return the pictures of several planes with all their reductions, for the kernel.

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
        height, width = (size // 2 for size in even.shape)
        half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
        images.append(np.asarray(half, np.uint8).reshape(height, width))
    return images


# Places in a pixel of its two by two rays, along either axis.
_WITHIN = np.array([-0.25, 0.25])
# An exposure is cut into instants between which no point moves by more than this (px) ...
_LONGEST_STEP = 1.0
# ... nor is it cut into more than this many.
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
        self, camera: Camera, planes: Sequence[TexturedPlane], settings: ImageSettings | None = None
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
        """Return the image (height, width) whose first row is exposed around ``stamp_ns``.

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
            float(_BACKGROUND), 0, len(lines), lines,
        )  # fmt: skip
        image: NDArray[np.float32] = lines.T if self._sideways else lines
        if self.settings.noise > 0.0:
            rng = np.random.default_rng(list(seed))
            image += self.settings.noise * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)

    def _exposure_instants(self, motion: TrueMotion, middle_ns: int) -> Array:
        """Return offsets (m,) in s from a row's time, evenly over the exposure."""
        exposure = self.settings.exposure
        if exposure == 0.0:
            return np.zeros(1)
        state = motion.state(middle_ns, np.zeros(1))
        away = (abs((state.positions[0] - one.corner) @ one.normal) for one in self.planes)
        nearest = max(float(min(away)), _NEAREST)
        speed = np.linalg.norm(state.angular[0]) + np.linalg.norm(state.linear[0]) / nearest
        travel = float(speed * exposure * self.camera.K[0, 0] / self.camera.binning[0])
        count = min(max(math.ceil(travel / _LONGEST_STEP), 1), _MOST_INSTANTS)
        return np.asarray(exposure * ((np.arange(count) + 0.5) / count - 0.5))


def _rays(camera: Camera, sideways: bool) -> NDArray[np.float32]:
    """Return bearings (lines, pixels, rays, 2) float32 of the rays of all pixels."""
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
_WORKERS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """One image; ``stamp_ns`` is the exposure of the first row, the middle row follows."""

    stamp_ns: int
    middle_ns: int
    data: bytes  # JPEG
    first_row: TrueState  # one instant: at stamp_ns
    middle_row: TrueState  # one instant: at middle_ns


def rendered_frames(
    renderer: Renderer, motion: TrueMotion, stamps_ns: Sequence[int], seed: int = 0
) -> Iterator[RenderedFrame]:
    """Yield frames along a motion, whose first rows are exposed at ``stamps_ns``.

    Each image has its own noise, from ``seed`` and its place in the list.
    """
    now = np.zeros(1)

    def frame(numbered: tuple[int, int]) -> RenderedFrame:
        index, stamp_ns = numbered
        middle_ns = middle_stamp(renderer.camera, stamp_ns)
        image = renderer.image(motion, stamp_ns, (seed, index))
        done, data = cv2.imencode(f".{FORMAT}", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        assert done
        return RenderedFrame(
            stamp_ns=stamp_ns, middle_ns=middle_ns, data=data.tobytes(),
            first_row=motion.state(stamp_ns, now), middle_row=motion.state(middle_ns, now),
        )  # fmt: skip

    # A few at a time wait to be taken.
    numbered = list(enumerate(stamps_ns))
    with ThreadPoolExecutor(_WORKERS) as pool:
        for first in range(0, len(numbered), 2 * _WORKERS):
            yield from pool.map(frame, numbered[first : first + 2 * _WORKERS])
