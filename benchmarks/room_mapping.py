# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rendered room that is mapped from one walk, and what other walks in it see."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments.trials import angles
from rs_localizer.config import FeatureConfig, NodeConfig, PoseTime
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.keypoints import FrameExtractor, keypoints
from rs_localizer.tools.mapping.anchors import Anchors
from rs_localizer.tools.mapping.build import Built, Given, Workshop, build_map
from rs_localizer.tools.mapping.gauge import through
from rs_localizer.tools.mapping.seen_images import Looker, SeenImage
from rs_localizer.tools.mapping.structure import Effort, Stage
from rs_localizer.tools.simulation.renderer import Renderer, in_order
from rs_localizer.tools.simulation.simulated_frames import frame_stamps, middle_stamp
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

    def __init__(
        self, trajectory: Trajectory, camera: Camera, sensor: ImageSettings, keypoints: int
    ) -> None:
        self.motion = RecordedMotion(trajectory)
        self.camera, self._most = camera, keypoints
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

        return in_order(render, self.stamps(piece))

    def look(self, piece: Piece, images: Path) -> list[SeenImage]:
        """The views of a piece; their images go to a folder."""
        looker = Looker(self._most, images, self.marker_map)
        return [looker.look(image) for image in self.images(piece)]

    def build(
        self,
        views: Sequence[SeenImage],
        folder: Path,
        stage: Stage | None = None,
        effort: Effort | None = None,
    ) -> Built:
        """The map, with its metres from the markers."""
        given = Given(
            views, self.camera, Anchors(self.marker_map), self.camera.readout_time,
            self.camera.scan_direction,
        )  # fmt: skip
        return build_map(given, Workshop(folder, effort or Effort(), stage or _silent))

    def clouds(self, piece: Piece) -> list[Any]:
        """The keypoints of a piece, as the node ``feature_detector`` sends them."""
        extractor = FrameExtractor(FeatureConfig(max_keypoints=self._most))
        return [keypoints(extractor.extract(image), make_message) for image in self.images(piece)]


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """How far poses are from the truth."""

    frames: int
    positions: Array  # (k,) m, of the localized frames
    angles: Array  # (k,) deg

    @property
    def share(self) -> float:
        return len(self.positions) / self.frames


def localized(room: Room, clouds: Sequence[Any], landmarks: Map, solver: str) -> Errors:
    """Of the poses of the middle rows, as ``replay`` gives them."""
    config = NodeConfig(
        solver=solver, readout_time=room.camera.readout_time, pose_time=PoseTime.MID_FRAME
    )
    localizer = FrameLocalizer(config)
    localizer.use_map(landmarks)
    positions, turns = [], []
    for cloud in clouds:
        stamp = stamp_ns(cloud)
        localizer.calibrate(read_camera_info(make_camera_info(room.camera, stamp)))
        answer = localizer.localize_keypoints(cloud)
        if answer:
            true = room.motion.state(middle_stamp(room.camera, stamp), np.zeros(1))
            positions.append(np.linalg.norm(answer.pose.position - true.positions[0]))
            turns.append(angles(answer.pose.rotation, true.rotations[0]))
    return Errors(len(clouds), np.array(positions), np.array(turns))


def without_refinement(built: Built) -> Map:
    """The map as a global shutter makes it: COLMAP's, laid onto the refined one as a whole."""
    landmarks = built.landmarks
    points = built.structure.start.points[built.kept]
    laid = through(points, landmarks.points)(points)
    return Map(laid, landmarks.ids, landmarks.descriptors, landmarks.frame)


@contextmanager
def _silent(name: str, total: int) -> Iterator[Callable[[int], object]]:
    yield lambda steps: None
