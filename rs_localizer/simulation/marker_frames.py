# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of the augmented-reality experiment: marker walls, rendered and detected; the truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.io.video import Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.prints import Marker
from rs_localizer.simulation.frames import frame_stamps, middle_stamp, true_poses_at
from rs_localizer.simulation.renderer import Renderer, in_order
from rs_localizer.simulation.settings import ImageSettings
from rs_localizer.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.simulation.walls import three_walls

CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
RATE = 30.0
SENSOR = ImageSettings(exposure=0.005, noise=2.0)
# A marker is visible when all of it is inside the image by this margin, and its shortest side and
# its height over the longest diagonal reach these lengths (px): OpenCV reads few smaller ones.
_MARGIN, _LEAST_SIDE, _LEAST_HEIGHT = 2.0, 16.0, 12.0
_WALL_BOUNDARY = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFrame:
    """What one image shows, and the truth at its middle row."""

    stamp_ns: int
    middle_ns: int
    points: Array  # (n,3) m, corners of the detected markers
    pixels: Array  # (n,2) raw
    visible: int  # markers that can be seen, by the truth
    position: Array  # (3,) m
    speed: float  # deg/s

    @property
    def is_flat(self) -> bool:
        """Whether all detected corners lie on one wall."""
        centred = self.points - self.points.mean(axis=0)
        spread = np.linalg.svd(centred, compute_uv=False)
        return bool(spread[-1] < _WALL_BOUNDARY * spread[0])


class MarkerWalls:
    """Three walls around a recorded motion, and the camera before them."""

    def __init__(self, trajectory: Trajectory, seed: int, sensor: ImageSettings = SENSOR) -> None:
        self.motion = RecordedMotion(trajectory)
        scene = three_walls(sampled_states(self.motion))
        assert scene.marker_map is not None
        self.markers: Sequence[Marker] = scene.marker_map.markers
        self._corners = scene.marker_map.points
        self._renderer = Renderer(CAMERA, scene.planes, sensor)
        self._detector = MarkerDetector(scene.marker_map)
        self._seed = seed

    def stamps(self) -> list[int]:
        """Of all frames within the motion."""
        return frame_stamps(self.motion, CAMERA, RATE)

    def frames(self, stamps_ns: Sequence[int]) -> Iterator[tuple[MarkerFrame, Image]]:
        """The frames with these stamps, and their images (height, width)."""
        return in_order(self._frame, stamps_ns)

    def _frame(self, stamp_ns: int) -> tuple[MarkerFrame, Image]:
        image = self._renderer.image(self.motion, stamp_ns, (self._seed, stamp_ns))
        detections = self._detector.detect(image)
        middle_ns = middle_stamp(CAMERA, stamp_ns)
        state = self.motion.state(middle_ns, np.zeros(1))
        frame = MarkerFrame(
            stamp_ns, middle_ns, detections.points, detections.pixels, self._visible(middle_ns),
            state.positions[0], float(np.degrees(np.linalg.norm(state.angular[0]))),
        )  # fmt: skip
        return frame, image

    def _visible(self, middle_ns: int) -> int:
        poses_at = true_poses_at(CAMERA, self.motion, middle_ns)
        quads = project_rolling(CAMERA, poses_at, self._corners)[0].reshape(-1, 4, 2)
        return int(np.count_nonzero(visible(quads, CAMERA.size)))


def visible(quads: Array, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which markers (m,) can be seen that have their corners at these raw pixels (m,4,2)."""
    with np.errstate(invalid="ignore"):  # NaN, behind the camera, compares false
        inside = (quads > _MARGIN) & (quads < np.array(size) - 1.0 - _MARGIN)
        sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2)
        one, other = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
        # Twice the area; negative when seen from behind.
        area = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
        longest = np.maximum(np.linalg.norm(one, axis=1), np.linalg.norm(other, axis=1))
        large = (sides.min(axis=1) >= _LEAST_SIDE) & (area >= _LEAST_HEIGHT * longest)
        visible_markers: NDArray[np.bool_] = inside.all(axis=(1, 2)) & large
    return visible_markers
