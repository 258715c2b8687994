# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscopes that are wrong: beside the camera alone no frame is worse, and what they have is said.

The independent simulator's frames and gyroscopes; the whole table is ``python -m
benchmarks.faulty_gyroscopes``.
"""

import numpy as np
import pytest

from benchmarks.aided import believed, record
from benchmarks.faulty_gyroscopes import FAULTS, followed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import hand
from benchmarks.independent.scenes import Wall
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

SEED = 3


@pytest.fixture(scope="module")
def alone():
    return followed(record(Camera(), hand, Wall(), (1, 60), SEED), with_imu=False)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("right", ""),
        ("scale 5 %", "it turns 5 % too fast"),
        ("scale 20 %", "it turns 20 % too fast"),
        ("mount 10 deg", "its mount is 10 deg off"),
        ("mount 20 deg", "its mount is 20 deg off"),
        ("late 40 ms", "its stamps are 40 ms late"),
        ("step 15 ms", "its stamps stepped by 16 ms"),
        ("saturated", "saturated"),
        ("turned about z", "the camera's x y z are its -y x z"),
    ],
)
def test_a_gyroscope_is_never_worse_than_none(fault, said, alone):
    found = followed(record(Camera(), hand, Wall(), (1, 60), SEED, FAULTS[fault]))
    for aided, own in ((found.orientation, alone.orientation), (found.rate, alone.rate)):
        assert np.isfinite(aided).all()
        assert np.median(aided) < 1.1 * np.median(own)
    assert np.mean(found.inside) >= 0.9
    assert fault != "turned about z" or found.used < 0.2
    if fault == "right":
        assert found.used > 0.95
        assert np.median(found.rate) < 0.2 * np.median(alone.rate)
    assert found.said == said


@pytest.mark.parametrize("seed", [4, 6])
def test_nothing_is_named_that_does_not_explain_what_images_deny(seed):
    recorded = record(Camera(), hand, Wall(), (1, 30), seed, FAULTS["sign of y"])
    assert followed(recorded).said == ""


def test_the_first_image_after_a_gap_is_aided():
    """Half a second after the last one a wall is seen where no track expected it."""
    recorded = record(Camera(), hand, Wall(), (1, 40), 2)
    frames, tracker = recorded.frames, Tracker(Localizer(believed(Camera())), recorded.aid())
    for frame in (*range(12), 27):
        seen, readings = frames.seen(frame, 0.3), recorded.around(frame)
        found = tracker.localize(frames.middle_ns(frame), *seen, readings=readings)
        assert found.aided
    assert not found.tracked
