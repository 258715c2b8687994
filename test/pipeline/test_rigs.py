# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pairs from message to pose, and what is said of a camera that is odd."""

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.io.bags import open_bag
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.replay import prepare_replay, replay
from rs_localizer.pipeline.rig_frames import CameraImage, FrameAssembler
from rs_localizer.settings import build, load_params_file

from .opposed_pair import PARTS, hand, record, rich


def localize(path, **settings):
    values = load_params_file(path / "parameters.yaml") | {"min_inliers": 20} | settings
    notices: list[tuple[str, str]] = []
    with open_bag(path) as bag:
        topics, localizer = prepare_replay(
            bag, build(values), notice=lambda name, text: notices.append((name, text))
        )
        answers = [answer.result for answer in replay(bag, topics, localizer)]
    frames = [answer for answer in answers if answer]
    return frames, [answer for answer in answers if not answer], notices


def errors(frame: Localized, motion) -> np.ndarray:
    """Errors (12,) of position, orientation, linear and angular velocity, over their deviations."""
    true = motion.state(frame.stamp_ns, np.zeros(1))
    turn = so3.log(np.ascontiguousarray(frame.pose.rotation @ true.rotations[0].T))
    assert frame.twist is not None
    pose = np.r_[frame.pose.position - true.positions[0], turn]
    twist = np.r_[frame.twist.linear - true.linear[0], frame.twist.angular - true.angular[0]]
    deviations = [np.sqrt(np.diag(it.covariance)) for it in (frame.pose, frame.twist)]
    return np.r_[pose, twist], np.concatenate(deviations)


@pytest.fixture(scope="module")
def opposed(tmp_path_factory):
    path = tmp_path_factory.mktemp("opposed") / "bag"
    return path, record(path)


@pytest.mark.parametrize("pose_time", ["stamp", "mid_frame"])
def test_an_opposed_pair_before_a_wall_knows_pose_and_velocity(opposed, pose_time):
    path, motion = opposed
    frames, refused, notices = localize(path, pose_time=pose_time)
    assert refused == []
    assert notices == []
    assert len(frames) >= 28
    found = np.array([errors(frame, motion) for frame in frames])
    off, deviations = found[:, 0], found[:, 1]
    size = np.linalg.norm(off.reshape(-1, 4, 3), axis=2)
    medians = np.median(size, axis=0)
    assert medians[0] < 0.01
    assert np.degrees(medians[1]) < 0.2
    assert medians[2] < 0.5
    assert np.degrees(medians[3]) < 12.0
    assert np.mean(np.abs(off) < 1.96 * deviations) > 0.85
    assert {frame.body_frame for frame in frames} == {"rig"}


@pytest.mark.parametrize("lag", [0, 2])
def test_the_last_frame_that_waits_for_a_camera_comes_at_the_end(tmp_path, lag):
    """An image of the other camera may still come while the recording goes on."""
    images: list[tuple[str, int]] = []

    def keep(image) -> bool:
        kept = image.name == "left" or image.stamp_ns < 1_200_000_000
        images.extend([(image.name, image.stamp_ns)] * kept)
        return kept

    record(tmp_path / "bag", 0.3, keep=keep)
    lefts = [stamp for name, stamp in images if name == "left"]
    rights = [stamp for name, stamp in images if name == "right"]
    assert 1 <= sum(stamp > rights[-1] + 20_000_000 for stamp in lefts) <= 3  # still awaited
    frames, refused, _ = localize(tmp_path / "bag", output_lag=lag)
    assert len(frames) + len(refused) == len(lefts)
    assert frames[-1].input_stamp_ns >= lefts[-1]


SIDEWAYS = np.array([0.3, 0.8, -0.5]) / np.linalg.norm([0.3, 0.8, -0.5])


def localize_turned(path, degrees):
    """Localize a hand's recording, of which the right camera is turned without being said to be."""
    motion, (rotation, translation) = hand(5.0, 1.0), PARTS.camera_from_rig["right"]
    mounted = so3.exp(np.radians(degrees) * SIDEWAYS) @ rotation, translation
    true = PARTS._replace(camera_from_rig=PARTS.camera_from_rig | {"right": mounted})
    record(path, motion=motion, points=rich(motion), true=true)
    return localize(path)


def test_a_camera_that_is_a_little_off_is_named_while_poses_go_on(tmp_path):
    frames, _, notices = localize_turned(tmp_path / "bag", 0.5)
    assert len(frames) > 20
    assert "extrinsics" in {name for name, _ in notices}


@pytest.mark.parametrize("degrees", [1.5, 3.0])
def test_a_wrong_extrinsic_is_named_and_no_pose_comes_of_it(tmp_path, degrees):
    """Of the two cameras, no image tells which is where it is said to be."""
    frames, refused, notices = localize_turned(tmp_path / "bag", degrees)
    assert len(frames) <= 1
    (said,) = {text for name, text in notices if name == "extrinsics"}
    assert said.startswith("left and right have poses of their own that disagree")
    assert said in refused[-1].detail


class Watched:
    def __init__(self, window=0.02):
        self.said = []
        names = ("front", "rear")
        self.pair = FrameAssembler(names, window, lambda _, text: self.said.append(text))

    def add(self, *times):
        """Images as "f33": of the front camera, in the middle of its exposure at 33 ms."""
        frames = []
        for text in times:
            name = {"f": "front", "r": "rear"}[text[0]]
            image = CameraImage(name, 0, round(1e6 * float(text[1:])), None)
            frames += self.pair.add(image)
        return [" ".join(f"{i.camera[0]}{i.middle_ns / 1e6:g}" for i in frame) for frame in frames]


@pytest.mark.parametrize(
    ("window", "order", "frames"),
    [
        *((0.02, order, "f0 r15, f33 r48, f67 r82")
          for order in ("f0 r15 f33 r48 f67 r82", "r15 f0 r48 f33 r82 f67")),
        # Images outside the window are frames of their own.
        (0.01, "f0 r15 f33 r48 f67 r68", "f0, r15, f33, r48, f67 r68"),
        # A recording may start over.
        (0.02, "f5000 r5001 f5033 r5034 f0 r1 f33 r34 f67 r68",
         "f5000 r5001, f5033 r5034, r1, f33 r34, f67 r68"),
    ],
)  # fmt: skip
def test_images_become_frames_whatever_comes_first(window, order, frames):
    watched = Watched(window)
    assert watched.add(*order.split()) == frames.split(", ")
    assert "f5000" in order or watched.said == []


def test_a_camera_that_stops_is_no_longer_awaited_and_named():
    watched = Watched()
    assert watched.add("f0", "r1", "f33", "r34") == ["f0 r1", "f33 r34"]
    # Its image may still come, until it is missing from three frames.
    assert watched.add("f67", "f100", "f133") == ["f67", "f100"]
    assert watched.said == []
    assert watched.add("f167", "f200") == ["f133", "f167", "f200"]
    assert watched.said[0] == "rear is left out: no image in the last 3 frames"
    del watched.said[:]
    # It starts again after the last frame has gone, and is awaited again.
    assert watched.add("r201", "f233", "f267", "r268") == ["r201", "f233", "f267 r268"]
    assert watched.said == []


def test_one_clock_that_jumps_stops_nobody_else():
    watched = Watched()
    assert watched.add("f0", "r1", "f33", "r34") == ["f0 r1", "f33 r34"]
    ahead = watched.add("f67", "r5067", "f100", "r5100", "f133", "r5133", "f167")
    assert [frame for frame in ahead if "f" in frame] == ["f67", "f100", "f133"]
    assert all("r" not in frame for frame in ahead)
    assert "rear is left out: its stamps are 4.967 s ahead of the others" in watched.said
    watched = Watched()
    watched.add("f5000", "r5001", "f5033", "r5034")
    back = watched.add("r0", "f5067", "r33", "f5100", "r67", "f5133", "r100", "f5167", "f5200")
    assert all("r" not in frame for frame in back)
    assert back[-2:] == ["f5167", "f5200"]
    assert watched.said[0] == "rear is left out: its stamps went back by 5.034 s"
