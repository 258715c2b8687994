# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs: what they accept, and when and from where their cameras see."""

import re

import numpy as np
import pytest

import rs_localizer as rsl

K = np.array([[450.0, 0.0, 319.5], [0.0, 450.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = rsl.Camera(640, 480, K, readout_time=0.03)
SLOW = rsl.Camera(640, 480, K, readout_time=0.05, scan_direction="bottom_to_top")
FORWARD = np.eye(3), np.zeros(3)
DOWN = np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.0])


def pair(**more):
    return rsl.Rig({"up": CAMERA, "down": SLOW}, {"up": FORWARD, "down": DOWN}, **more)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (({}, {}), "{name: camera}"),
        (({"a": CAMERA}, {}), "lacks 'a'"),
        (({"a": CAMERA}, {"a": (np.diag([1.0, 1.0, -1.0]), np.zeros(3))}), "no rotation"),
        (
            ({"a": CAMERA, "b": rsl.Camera(640, 480, K)}, {"a": FORWARD, "b": FORWARD}),
            "b: a camera of a rig needs its readout_time",
        ),
    ],
)
def test_impossible_rigs_are_refused_by_what_was_found(arguments, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        rsl.Rig(*arguments)


def test_row_times_count_from_the_middle_of_all_exposures():
    """The first camera is read from 1 to 1.03 s, the second from 1.02 to 1.07, its rows upwards."""
    exposure = pair(time_offset={"down": 0.005}).exposure(stamps={"up": 1.0, "down": 1.015})
    assert exposure.time == pytest.approx(1.035)
    assert exposure.span == pytest.approx(0.07)
    rows = np.array([[5.0, 0.0], [5.0, 479.0], [5.0, 100.0]])
    for place, first, last in ((0, 1.0, 1.03), (1, 1.07, 1.02)):
        times = exposure.time + exposure.span * exposure.row_time(place, rows)
        np.testing.assert_allclose(times, first + (last - first) * rows[:, 1] / 479.0, atol=1e-12)
        # The gradient by the pixel is that of these times.
        step = exposure.row_time(place, rows + np.array([0.0, 1.0])) - exposure.row_time(
            place, rows
        )
        np.testing.assert_allclose(step, exposure.mounts.gradients[place, 1], rtol=1e-9)


def test_stamps_are_those_of_the_first_delivered_row():
    """Of 480 rows the last 120 are delivered: the sensor began 3/4 of a readout earlier."""
    cropped = rsl.Camera(640, 480, K, readout_time=0.0479, roi=rsl.Roi(0, 360, 640, 120))
    rig = rsl.Rig({"a": cropped}, {"a": FORWARD})
    exposure = rig.exposure(stamps={"a": 10.0})
    first = exposure.time + exposure.span * exposure.row_time(0, np.zeros((1, 2)))
    np.testing.assert_allclose(first, 10.0, atol=1e-12)


def test_stamps_must_be_of_one_frame():
    with pytest.raises(ValueError, match="no camera 'left'"):
        pair().exposure(["left"])
    with pytest.raises(ValueError, match="lack 'down'"):
        pair().exposure(stamps={"up": 1.0})
    with pytest.raises(ValueError, match="in seconds"):
        pair().exposure(stamps={"up": 0.0, "down": 33.3})
