# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of images: their own, or those of a rate; and what speaks against it."""

import numpy as np
import pytest

from rs_localizer.io.image_clock import ImageClock, TimesError, readout_fault

MS = 1_000_000
# Milliseconds of a phone that leaves images out: 10 images/s on average.
OWN = [0, 33, 67, 100, 300]


def test_presentation_times_from_one_second_on():
    clock = ImageClock()
    assert [clock.relative(ms * MS) for ms in OWN] == [10**9 + ms * MS for ms in OWN]
    assert clock.relative(None) is None
    assert clock.description() == (
        "times: the presentation times of the video, 13.33 images/s on average; the first image at "
        "1 s (--start sets it)"
    )
    assert clock.fault() is None


def test_a_rate_overrides_and_is_compared():
    clock = ImageClock(rate=30.0, start_ns=5 * 10**9)
    stamps = [clock.relative(ms * MS) for ms in OWN]
    assert stamps == [5 * 10**9 + round(k * 1e9 / 30) for k in range(5)]
    assert clock.description() == "times: --rate 30; the first image at 5 s (--start sets it)"
    fault = clock.fault()
    assert fault is not None
    assert "--rate 30 disagrees with the file, whose own times mean 13.33 images/s" in fault
    near = ImageClock(rate=13.34)
    assert all(near.relative(ms * MS) for ms in OWN)
    assert near.fault() is None
    without = ImageClock(rate=30.0)
    assert without.relative(None) == 10**9
    assert without.fault() is None


def test_names_that_are_times():
    clock = ImageClock()
    assert [clock.absolute(10**18 + k) for k in (0, 7)] == [10**18, 10**18 + 7]
    assert "the names of the files" in clock.description()
    moved = ImageClock(start_ns=3)
    assert [moved.absolute(10**18 + k) for k in (0, 7)] == [3, 10]


@pytest.mark.parametrize("first", [(), (0,)])  # the first of some files has a time, always
def test_without_times_there_must_be_a_rate(first):
    clock = ImageClock()
    for own_ns in first:
        clock.relative(own_ns)
    with pytest.raises(TimesError, match="give --rate"):
        clock.relative(None)


def test_a_readout_longer_than_a_period():
    assert readout_fault(0.03, 0.033) is None
    assert readout_fault(0.03, np.nan) is None
    fault = readout_fault(0.05, 0.033)
    assert fault is not None
    assert "50 ms is longer than the 33 ms from image to image" in fault
