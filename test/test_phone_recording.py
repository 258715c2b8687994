# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A real phone with true stamps: its replayed twists before its gyroscope, which nothing reads."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.data import PHONE, PHONE_GYROSCOPE
from rs_localizer.cli.commands import main
from rs_localizer.io.trajectories import read_twists

READOUT_TIME = 0.0318
IMAGES, PERIOD = 40, 1.0 / 30.02


def gyroscope_at(middle_rows):
    """Mean turn rates (n,3), deg/s, of images with these middle rows (n,), s."""
    table = np.loadtxt(PHONE_GYROSCOPE)
    during = np.abs(table[:, 0] - middle_rows[:, None]) < 0.5 * READOUT_TIME
    assert during.sum(axis=1).min() >= 12  # 412 Hz
    return np.rad2deg(during @ table[:, 1:] / during.sum(axis=1)[:, None])


def errors_of(found, shift=0.0):
    """Of rates (n,3) at times (n,), deg/s, before the gyroscope so much later."""
    times, rates = found
    return np.linalg.norm(rates - gyroscope_at(times + shift), axis=1)


def twists(out: Path, *settings):
    """Times (n,) s and turn rates (n,3) deg/s that ``replay`` writes."""
    assigned = [word for each in ("pose_time:=mid_frame", *settings) for word in ("-p", each)]
    parameters = str(PHONE / "parameters.yaml")
    assert main(["replay", str(PHONE), "--params", parameters, *assigned, "--out", str(out)]) == 0
    found = read_twists(out / "twists.txt")
    return 1e-9 * found.stamps_ns, np.rad2deg(found.angular)


def slopes(found, truth):
    """What the truth is multiplied with to give the rates about each axis (3,)."""
    return np.sum(found * truth, axis=0) / np.sum(truth**2, axis=0)


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    return twists(tmp_path_factory.mktemp("phone") / "out")


def test_tracked_twists_are_those_of_the_gyroscope(at_once):
    times, _ = at_once
    assert len(times) == IMAGES - 1  # no frame before the first one tells its twist
    assert np.linalg.norm(gyroscope_at(times), axis=1).max() > 30.0  # there is something to tell
    assert np.median(errors_of(at_once)) < 3.5
    assert np.percentile(errors_of(at_once), 95) < 10.0


def test_one_image_later_they_are_twice_as_near(tmp_path, at_once):
    times, rates = later = twists(tmp_path / "out", "output_lag:=1")
    # The scale, and all of z, depend on the focal length, which the clip hardly tells.
    assert np.all(np.abs(slopes(rates, gyroscope_at(times)) - 1.0) < [0.2, 0.2, 0.4])
    assert np.median(errors_of(later)) < 0.6 * np.median(errors_of(at_once))


def test_stamps_of_another_image_and_a_reversed_shutter_are_told(tmp_path, at_once):
    """What the first test would miss if it could not fail."""
    for shift in (-PERIOD, PERIOD):
        assert np.median(errors_of(at_once, shift)) > 1.5 * np.median(errors_of(at_once))
    times, rates = twists(tmp_path / "out", "scan_direction:=bottom_to_top", "tracking:=false")
    assert slopes(rates, gyroscope_at(times))[0] < -0.5
