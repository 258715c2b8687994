# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rendered walls of markers along recorded hands, through the detector and the node's own code.

Rendering and detection take minutes, the estimator seconds: detected corners and the truth are
written to a recording that the next run finds (``folder``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.data import HAND_MOTION, SLOW_HAND_MOTION
from benchmarks.honesty.estimating import Found
from benchmarks.honesty.scores import Score, Scores, Truth, percent, score
from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC, write_frame
from rs_localizer.io.trajectories import read_motions, read_tum
from rs_localizer.markers.detection import Detections, MarkerDetector
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.tools.simulation.frames import frame_stamps, middle_stamp
from rs_localizer.tools.simulation.recording import TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC, write_truth
from rs_localizer.tools.simulation.renderer import Renderer, in_order
from rs_localizer.tools.simulation.settings import ImageSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import three_walls

MOTIONS = {
    "tum_vi_room5": (HAND_MOTION, "forward_left_up"),
    "tum_rgbd_fr1_xyz": (SLOW_HAND_MOTION, "optical"),
}
"""Trajectories by name, and the axes of the body whose poses they hold."""
SECONDS = 10.0
_RATE = 30.0
_SENSOR = ImageSettings(exposure=0.005, noise=2.0)
_LEAST_CORNERS = 12  # three markers: fewer are no frame of ours
_BLOCK_NS = 500_000_000  # frames of half a second are not independent


@dataclass(frozen=True, slots=True)
class Condition:
    """A recording, and whether its frames are tracked."""

    motion: str
    tracking: bool

    @property
    def name(self) -> str:
        return f"{self.motion}/{'tracked' if self.tracking else 'single'}"


def conditions() -> Sequence[Condition]:
    return [Condition(*point) for point in product(MOTIONS, (False, True))]


def measure(condition: Condition, folder: Path, seconds: float = SECONDS) -> Found:
    """The scores of the frames that show three markers or more, at both moments."""
    recording = folder / f"{condition.motion}_{seconds:g}s"
    if not recording.exists():
        _render(*MOTIONS[condition.motion], recording, seconds)
    stamp, middle = (
        _scores(recording, condition.tracking, moment)
        for moment in (PoseTime.STAMP, PoseTime.MID_FRAME)
    )
    return Found(stamp, middle)


def _camera() -> Camera:
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    return Camera(width=640, height=480, K=K, readout_time=0.03)


def _render(trajectory: Path, axes: str, recording: Path, seconds: float) -> None:
    """Corners that the detector finds in the images, and the truth."""
    camera = _camera()
    motion = RecordedMotion(read_tum(trajectory), axes)
    first = motion.intervals_ns[0][0]
    stamps = [
        stamp
        for stamp in frame_stamps(motion, camera, _RATE)
        if stamp < first + round(seconds * 1e9)
    ]
    scene = three_walls(sampled_states(motion))
    assert scene.marker_map is not None
    renderer = Renderer(camera, scene.planes, _SENSOR)
    detector = MarkerDetector(scene.marker_map)

    def image(numbered: tuple[int, int]) -> tuple[int, Detections]:
        index, stamp_ns = numbered
        shown = renderer.image(motion, stamp_ns, (0, index))
        return stamp_ns, detector.detect(shown, stamp_ns)

    recording.parent.mkdir(parents=True, exist_ok=True)
    unfinished = recording.with_name(f"{recording.name}_unfinished")
    now = np.zeros(1)
    with BagWriter(unfinished) as bag:
        for stamp_ns, seen in in_order(image, enumerate(stamps)):
            if len(seen.ids) < _LEAST_CORNERS:
                continue
            write_frame(bag, camera, stamp_ns, seen.points, seen.pixels, seen.ids)
            for instant in (stamp_ns, middle_stamp(camera, stamp_ns)):
                write_truth(bag, instant, motion.state(instant, now))
    unfinished.rename(recording)


def _scores(recording: Path, tracking: bool, moment: PoseTime) -> Scores:
    camera = _camera()
    truths = _truths(recording)
    config = NodeConfig(readout_time=camera.readout_time, tracking=tracking, pose_time=moment.value)
    localizer = FrameLocalizer(config)
    scores: list[Score] = []
    with open_bag(recording) as bag:
        for topic, stamp_ns, message in bag.messages((CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC)):
            if topic == CAMERA_INFO_TOPIC:
                localizer.calibrate(read_camera_info(message))
                continue
            found, block = localizer.localize(message), stamp_ns // _BLOCK_NS
            scores.append(
                Score(block, found.reason)
                if isinstance(found, Refusal)
                else score(found.pose, found.twist, truths[found.stamp_ns], block)
            )
    return Scores(scores)


def _truths(recording: Path) -> dict[int, Truth]:
    read = read_motions(recording, TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC)
    assert read.twists is not None
    rotations = Rotation.from_quat(read.poses.quaternions).as_matrix()
    return {
        stamp: Truth(*state)
        for stamp, *state in zip(
            read.poses.stamps_ns.tolist(),
            rotations,
            read.poses.positions,
            read.twists.angular,
            read.twists.linear,
            strict=True,
        )
    }


COLUMNS = (
    "condition", "frames", "pose@stamp", "pose@mid", "twist@stamp", "twist@mid",
    "over_5_sigma", "deg@stamp", "deg@mid", "mm@stamp", "mm@mid", "deg/s@mid", "m/s@mid",
    "refused", "reasons",
)  # fmt: skip


def row(name: str, found: Found) -> tuple[str | float | int, ...]:
    """Shares in %, medians of the errors."""
    stamp, middle = found.stamp, found.middle
    return (
        name,
        len(middle),
        *(percent(scores.inside("pose")) for scores in (stamp, middle)),
        *(percent(scores.inside("twist")) for scores in (stamp, middle)),
        max(percent(scores.far_off()) for scores in (stamp, middle)),
        *(scores.median("orientation") for scores in (stamp, middle)),
        *(1e3 * scores.median("position") for scores in (stamp, middle)),
        middle.median("angular"),
        middle.median("linear"),
        100.0 * middle.refused,
        middle.reasons(),
    )
