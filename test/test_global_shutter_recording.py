# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The bundled recording of a real global shutter: nothing moves within its images."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.data import GLOBAL_SHUTTER_TAGS
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import open_bag
from rs_localizer.offline.replay import find_topics, replay
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.pose_at_time import twist_at

from .moving import squared

# Of 6 dimensions: what 95 % of a chi-squared variable lie below.
REGION = 12.59


def replayed(count, **settings):
    """What the node would publish, a pose of each of so many frames, and what it would say."""
    notices = list[str]()
    localizer = CameraFrames(NodeConfig(**settings), lambda _, text: notices.append(text))
    with open_bag(GLOBAL_SHUTTER_TAGS) as bag:
        answers = replay(bag, find_topics(bag), localizer)
        frames = [found for _, (*_, found) in zip(range(count), answers, strict=False)]
    assert all(frames)
    return frames, notices


def jitter(frames):
    """Second differences of the orientation (deg)."""
    poses = [Rotation.from_matrix(frame.pose.rotation) for frame in frames]
    turns = [(a.inv() * b).as_rotvec() for a, b in pairwise(poses)]
    return np.degrees(np.linalg.norm(np.diff(turns, axis=0), axis=1))


def test_a_global_shutter_stays_one():
    frames, notices = replayed(100, readout_time=0.02)
    assert any("(a global shutter)" in text for text in notices)
    own, p3p = jitter(frames), jitter(replayed(100, solver="p3p")[0])
    # Frame by frame: medians of the same poses differ by a twentieth by chance.
    assert np.median(own / p3p) <= 1.05
    assert np.quantile(own, 0.95) <= 1.05 * np.quantile(p3p, 0.95)
    still = []
    for frame in frames:
        twist = twist_at(frame.estimate, 0.0, 1.0)  # per readout
        velocities = np.concatenate([twist.linear, twist.angular])
        still.append(not velocities.any() or squared(velocities, twist.covariance) < REGION)
    assert np.mean(still) >= 0.99
