"""Calibration of whole recordings of the tests' own projector, and of the real ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import projector
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.trajectory import verdict
from rs_localizer.trajectory.calibration import Calibration, calibrate
from rs_localizer.trajectory.first_lens import first_lens
from rs_localizer.trajectory.observe import Observed, in_order
from rs_localizer.trajectory.stamps import examine

CAMERA = Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, D=projector.D)


@cache
def recording(
    readout: float = 0.02, points: str = "board", turn: float = 0.1, seconds: float = 2.5,
    outliers: float = 0.0, noise: float = 0.1, seed: int = 21,
) -> tuple[Observed, ...]:  # fmt: skip
    rng = np.random.default_rng(seed)
    motion = projector.Motion.random(rng, turn, 0.8 * turn)
    landmarks = projector.board() if points == "board" else projector.room(rng)
    frames = projector.record(rng, motion, landmarks, readout=readout, seconds=seconds,
                              noise=noise, outliers=outliers)  # fmt: skip
    return tuple(Observed(round(1e9 * (10.0 + f.stamp)), f.points, f.pixels) for f in frames)


def agrees(found: Calibration, readout: float, least: float) -> None:
    assert found.determined
    assert abs(found.readout_time - readout) < 4.0 * found.deviation
    assert found.deviation < least


@pytest.mark.parametrize(("points", "outliers", "noise"), [("board", 0.0, 0.1), ("room", 0.3, 0.5)])
def test_readout_time_and_direction(points: str, outliers: float, noise: float) -> None:
    found = calibrate(CAMERA, list(recording(0.02, points, outliers=outliers, noise=noise)))
    agrees(found, 0.02, 1e-4)
    assert verdict.scan_direction(found) == "top_to_bottom"
    assert found.odds > 10.0
    assert found.jitter == 0.0
    assert verdict.refusal(found) == ""


def test_the_reversed_direction_is_found() -> None:
    found = calibrate(CAMERA, list(recording(-0.02)))
    agrees(found, -0.02, 1e-4)
    assert verdict.scan_direction(found) == "bottom_to_top"
    says_what_it_holds(found)


def says_what_it_holds(found: Calibration) -> None:
    """A board whose shape is free is worth no word, one with too many corners is."""
    assert found.held == 0
    seen = found.posed.observations
    large = replace(seen, landmarks=np.zeros((500, 3)), points=np.zeros(15_000, dtype=np.int64))
    held = replace(
        found,
        posed=replace(found.posed, observations=large),
        fit=replace(found.fit, freedom=replace(found.fit.freedom, landmarks=0.0)),
    )
    assert held.held == 500
    assert any("map's 500 points" in remark for remark in verdict.remarks(held))


def test_a_global_shutter_is_one() -> None:
    found = calibrate(CAMERA, list(recording(0.0)))
    assert found.global_shutter
    assert abs(found.readout_time) < 3.0 * found.deviation < 3e-4
    assert verdict.readout_time(found) == 0.0
    assert "global shutter" in " ".join(verdict.remarks(found))


def test_a_camera_at_rest_determines_nothing() -> None:
    found = calibrate(CAMERA, list(recording(0.02, turn=1e-5, seconds=1.2)))
    assert not found.determined
    assert "not observable" in verdict.refusal(found)


def test_irregular_stamps_are_noticed_and_do_little_harm() -> None:
    rng = np.random.default_rng(1)
    images = [
        replace(image, stamp_ns=image.stamp_ns + round(3e6 * rng.normal()))
        for image in recording(0.02, seconds=3.0)
    ]
    found = calibrate(CAMERA, images)
    agrees(found, 0.02, 1e-3)
    assert found.stamps.irregular
    assert found.jitter == pytest.approx(3e-3, rel=0.3)
    assert any("irregular" in remark for remark in verdict.remarks(found))


def test_a_picture_that_is_turned_after_the_fact_makes_parts_disagree() -> None:
    """Stabilisation: a part of the motion is taken out of the images, more or less of it."""
    images = list(recording(0.02, seconds=1.3)) + [
        replace(image, stamp_ns=image.stamp_ns + 10**10)
        for image in recording(0.008, seconds=1.3, seed=22)
    ]
    found = calibrate(CAMERA, images)
    assert found.stabilised
    assert "stabilisation" in verdict.refusal(found) + " ".join(verdict.remarks(found))


def test_a_lens_from_nothing() -> None:
    images = list(recording(0.02, seconds=3.0, turn=0.15))
    camera = first_lens((projector.WIDTH, projector.HEIGHT), in_order(images))
    assert camera.K[0, 0] == pytest.approx(projector.FOCAL, rel=0.3)
    found = calibrate(camera, images, intrinsics=True)
    agrees(found, 0.02, 2e-4)
    lens = np.array(found.fit.state.lens)
    deviations = np.sqrt(np.diag(found.fit.border_covariance)[1:5])
    truth = projector.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    assert np.all(np.abs(lens[:4] - truth) < 5.0 * deviations)
    assert lens[0] == pytest.approx(projector.FOCAL, rel=0.01)


def test_too_little_is_refused_with_figures() -> None:
    images = list(recording())
    with pytest.raises(ValueError, match="5 images show the map, at least 20"):
        calibrate(CAMERA, images[:5])
    elsewhere = [replace(image, pixels=image.pixels[::-1] * 0.3) for image in images]
    with pytest.raises(ValueError, match="of 75 images have a pose"):
        calibrate(CAMERA, elsewhere)


def test_stamps_of_an_even_camera_with_missing_images() -> None:
    times = np.delete(np.arange(100) / 30.0, [10, 11, 50])
    found = examine(times)
    assert found.interval == pytest.approx(1 / 30, rel=1e-9)
    assert found.missing == 3
    assert not found.irregular
