# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rendered room with markers, filmed along a recorded motion."""

from collections.abc import Iterator
from dataclasses import dataclass

from rs_localizer.core.camera import Camera
from rs_localizer.io.images import Image
from rs_localizer.io.recording import CAMERA_FRAME
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.tools.simulation.renderer import Renderer
from rs_localizer.tools.simulation.simulated_frames import frame_stamps
from rs_localizer.tools.simulation.simulated_settings import ImageSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import marked_room


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of the recorded motion."""

    start: float  # s
    duration: float  # s
    rate: float = 30.0  # Hz


class Room:
    """The room, and a camera along a recorded motion in it."""

    def __init__(self, trajectory: Trajectory, camera: Camera, sensor: ImageSettings) -> None:
        self.motion = RecordedMotion(trajectory)
        self.camera = camera
        scene = marked_room(sampled_states(self.motion))
        assert scene.marker_map is not None
        self.marker_map = scene.marker_map
        self.planes = scene.planes
        self._renderer = Renderer(camera, scene.planes, sensor)

    def stamps(self, piece: Piece) -> list[int]:
        """When the images of a piece begin, ns."""
        start = self.motion.intervals_ns[0][0] + round(1e9 * piece.start)
        end = start + round(1e9 * piece.duration)
        all_stamps = frame_stamps(self.motion, self.camera, piece.rate)
        return [stamp for stamp in all_stamps if start <= stamp < end]

    def images(self, piece: Piece) -> Iterator[Image]:
        """The rendered images of a piece."""

        def render(stamp: int) -> Image:
            pixels = self._renderer.image(self.motion, stamp, (0, stamp))
            return Image(stamp, CAMERA_FRAME, pixels)

        return map(render, self.stamps(piece))
