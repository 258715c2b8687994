# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rendered room that is mapped from one walk, and flights that are localized in the map."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.config import FeatureConfig, NodeConfig, PoseTime
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.outputs import Localized
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.mapping.anchors import Anchors
from rs_localizer.mapping.build import Built, Given, Workshop, build_map
from rs_localizer.mapping.colmap import Effort, Stage
from rs_localizer.mapping.gauge import through
from rs_localizer.mapping.views import Looker, View
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.keypoints import FrameExtractor, keypoints
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.simulation.frames import frame_stamps, middle_stamp
from rs_localizer.simulation.renderer import Renderer, in_order
from rs_localizer.simulation.settings import ImageSettings
from rs_localizer.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.simulation.walls import marked_room


@dataclass(frozen=True, slots=True)
class Piece:
    """A part of the recorded motion."""

    start: float  # s
    duration: float  # s
    rate: float = 30.0  # Hz


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """How far poses are from the truth."""

    frames: int
    positions: Array  # (k,) m, of the localized frames
    angles: Array  # (k,) deg

    @property
    def share(self) -> float:
        return len(self.positions) / self.frames


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

    def look(
        self,
        piece: Piece,
        images: Path,
        done: Callable[[], object] = lambda: None,
        markers: bool = True,
    ) -> list[View]:
        """The views of a piece, with the markers or without; their images go to a folder."""
        looker = Looker(self._most, images, self.marker_map if markers else None)
        views = []
        for image in self.images(piece):
            views.append(looker.look(image))
            done()
        return views

    def build(
        self,
        views: Sequence[View],
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

    def clouds(self, piece: Piece, done: Callable[[], object] = lambda: None) -> list[Any]:
        """The keypoints of a piece, as the node ``feature_detector`` sends them."""
        extractor = FrameExtractor(FeatureConfig(max_keypoints=self._most))
        clouds = []
        for image in self.images(piece):
            clouds.append(keypoints(extractor.extract(image), make_message))
            done()
        return clouds

    def localized(
        self, clouds: Iterable[Any], landmarks: Map, solver: str
    ) -> dict[int, Localized | Refusal]:
        """The poses of the middle rows by the stamps of the images, as ``replay`` gives them."""
        config = NodeConfig(
            solver=solver, readout_time=self.camera.readout_time, pose_time=PoseTime.MID_FRAME
        )
        localizer = FrameLocalizer(config)
        localizer.use_map(landmarks)
        answers = {}
        for cloud in clouds:
            stamp = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec
            localizer.calibrate(read_camera_info(make_camera_info(self.camera, stamp)))
            answers[stamp] = localizer.localize_keypoints(cloud)
        return answers

    def errors(self, answers: dict[int, Localized | Refusal]) -> Errors:
        """Of poses for the middle rows."""
        positions, angles = [], []
        for stamp, answer in answers.items():
            if isinstance(answer, Refusal):
                continue
            true = self.motion.state(middle_stamp(self.camera, stamp), np.zeros(1))
            positions.append(np.linalg.norm(answer.pose.position - true.positions[0]))
            turn = true.rotations[0].T @ answer.pose.rotation
            # Of half the angle: the trace says little of small ones.
            sine = np.linalg.norm(turn - np.eye(3)) / np.sqrt(8.0)
            angles.append(2.0 * np.degrees(np.arcsin(min(sine, 1.0))))
        return Errors(len(answers), np.array(positions), np.array(angles))


def without_refinement(built: Built) -> Map:
    """The map as a global shutter makes it: COLMAP's, laid onto the refined one as a whole."""
    landmarks = built.landmarks
    points = built.structure.points[built.kept]
    laid = through(points, landmarks.points)(points)
    return Map(laid, landmarks.ids, landmarks.descriptors, landmarks.frame)


@contextmanager
def _silent(name: str, total: int) -> Iterator[Callable[[int], object]]:
    yield lambda steps: None
