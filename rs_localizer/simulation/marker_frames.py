# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Three marker walls around a recorded motion, rendered and detected: what the cube stands on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.io.video import Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.prints import Marker
from rs_localizer.simulation.frames import frame_stamps, middle_stamp
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


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFrame:
    """What is detected in one image."""

    stamp_ns: int
    middle_ns: int
    points: Array  # (n,3) m, corners of the detected markers
    pixels: Array  # (n,2) raw


class MarkerWalls:
    """Three walls around a recorded motion, and the camera before them."""

    def __init__(self, trajectory: Trajectory, seed: int, sensor: ImageSettings = SENSOR) -> None:
        self.motion = RecordedMotion(trajectory)
        scene = three_walls(sampled_states(self.motion))
        assert scene.marker_map is not None
        self.markers: Sequence[Marker] = scene.marker_map.markers
        self._renderer = Renderer(CAMERA, scene.planes, sensor)
        self._detector = MarkerDetector(scene.marker_map)
        self._seed = seed

    def stamps(self) -> list[int]:
        """Of all frames within the motion."""
        return frame_stamps(self.motion, CAMERA, RATE)

    def frames(self, stamps_ns: Sequence[int]) -> Iterator[tuple[MarkerFrame, Image]]:
        """The frames with these stamps, and their images (height, width)."""

        def frame(stamp_ns: int) -> tuple[MarkerFrame, Image]:
            image = self._renderer.image(self.motion, stamp_ns, (self._seed, stamp_ns))
            found = self._detector.detect(image)
            middle_ns = middle_stamp(CAMERA, stamp_ns)
            return MarkerFrame(stamp_ns, middle_ns, found.points, found.pixels), image

        return in_order(frame, stamps_ns)
