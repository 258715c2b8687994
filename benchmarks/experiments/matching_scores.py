# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the scores of matches by descriptor help the search where most matches are wrong."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np

from benchmarks.experiments.results import Claim, Context, Statement
from rs_localizer.config import Matching
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.localizer import Localizer
from rs_localizer.matching import Matcher
from rs_localizer.simulation.frames import SimulatedFrame, simulate_frames
from rs_localizer.simulation.scene import random_descriptors, seen_descriptors
from rs_localizer.simulation.settings import FrameSettings
from rs_localizer.simulation.true_motion import TrueMotion

_FRAMES = 12
_WRONG = 0.9
# Where samples are plenty, the search finds the right ones without scores, too.
_SAMPLES = 200
# Neither test removes wrong matches: the scores alone tell them from right ones.
_EVERYTHING = Matching(ratio=1.0, mutual=False)


def scores_claim(
    context: Context, camera: Camera, motion: TrueMotion, stamps: Sequence[int], points: Array
) -> Claim:
    """Frames nine tenths of whose keypoints show what is not in the map."""
    seen = FrameSettings(points=500, noise=0.7, outliers=_WRONG)
    frames = simulate_frames(
        camera, motion, points, seen, stamps_ns=list(stamps[:_FRAMES]), seed=context.seed
    )
    rng = np.random.default_rng(context.seed)
    landmarks = Map(points, None, random_descriptors(len(points), rng), "map")
    matcher = Matcher(landmarks)
    localizer = Localizer(camera, max_iterations=_SAMPLES)
    found = {"with": 0, "without": 0}
    count = 0
    for frame in islice(context.track(frames, _FRAMES), _FRAMES):
        keypoints = _keypoints(frame, landmarks, rng)
        matches = matcher.match(keypoints, _EVERYTHING)
        given = points[matches.landmarks], keypoints.pixels[matches.keypoints]
        found["with"] += bool(localizer.localize(*given, matches.scores))
        found["without"] += bool(localizer.localize(*given))
        count += 1
    return Statement(
        "matching.scores",
        "this project",
        f"where {_WRONG:.0%} of the keypoints show what is not in the map, the scores of their "
        "matches lead the search to the right ones",
        f"all frames localized with scores and {_SAMPLES} samples, fewer without",
    ).judged(
        f"{found['with']} and {found['without']} of {count}",
        found["with"] == count > found["without"],
    )


def _keypoints(frame: SimulatedFrame, landmarks: Map, rng: np.random.Generator) -> Keypoints:
    assert landmarks.descriptors is not None
    descriptors = seen_descriptors(landmarks.descriptors[frame.ids], rng)
    strangers = ~frame.inliers
    width = descriptors.shape[1]
    descriptors[strangers] = random_descriptors(int(strangers.sum()), rng, width)
    return Keypoints(frame.stamp_ns, frame.pixels, None, descriptors, None, 0)
