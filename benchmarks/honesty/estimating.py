# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of the independent simulator through the estimator's public interfaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from benchmarks.honesty.scores import Score, Scores, Truth, score_at
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import Frames, MakeMotions, simulate
from benchmarks.independent.motions import States
from benchmarks.independent.scenes import Scene
from rs_localizer.core import camera as core
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

LENGTH = 8  # frames of a recording
COUNTED = 5  # the last ones: the tracker has had three to settle

_simulated = lru_cache(maxsize=4)(simulate)


@dataclass(frozen=True, slots=True)
class Found:
    """The scores of one condition, at both moments that can be published."""

    stamp: Scores
    middle: Scores


def frames_of(
    camera: Camera,
    make_motions: MakeMotions,
    scene: Scene,
    frames: int,
    seed: int,
    length: int = LENGTH,
) -> Frames:
    """Recordings of ``length`` frames with at least ``frames`` counted ones."""
    recordings = max(1, -(-frames // min(length, COUNTED)))
    return _simulated(camera, make_motions, scene, recordings, length, seed)


def believed(
    camera: Camera, readout_time: float | None = None, distortion_off: float = 0.0
) -> core.Camera:
    """What the user says of a camera: its lens may be off by a share of its distortion."""
    return core.Camera(
        width=camera.width,
        height=camera.height,
        K=camera.matrix,
        D=(1.0 - distortion_off) * np.array(camera.distortion),
        distortion_model="plumb_bob",
        readout_time=camera.readout_time if readout_time is None else readout_time,
        scan_direction=camera.scan.value,
    )


def estimate(
    frames: Frames, localizer: Localizer, noise: float, tracking: bool
) -> dict[int, Estimate | Failure]:
    """Results of the counted frames, by their place in ``frames``."""
    found: dict[int, Estimate | Failure] = {}
    tracker = Tracker(localizer) if tracking else None
    first_counted = int(frames.place.max()) + 1 - COUNTED
    for frame in range(len(frames)):
        place = int(frames.place[frame])
        if place == 0 and tracker is not None:
            tracker.reset()
        counted = place >= first_counted
        if tracker is None and not counted:
            continue
        seen = frames.seen(frame, noise)
        result = (
            localizer.localize(*seen)
            if tracker is None
            else tracker.localize(frames.middle_ns(frame), *seen)
        )
        if counted:
            found[frame] = result
    return found


def scored(frames: Frames, results: dict[int, Estimate | Failure], camera: core.Camera) -> Found:
    """Results against the truth, at the first row and at the middle one."""

    def at(tau: float, states: States) -> Scores:
        scores: list[Score] = []
        for frame, result in results.items():
            truth = truth_of(states, frame)
            recording = int(frames.recording[frame])
            scores.append(score_at(result, tau, camera.readout_time, truth, recording))
        return Scores(scores)

    return Found(at(camera.first_row_time, frames.first), at(0.0, frames.middle))


def truth_of(states: States, frame: int) -> Truth:
    """One of many states."""
    return Truth(*(getattr(states, name)[frame] for name in Truth.__slots__))
