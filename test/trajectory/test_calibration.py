# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration of whole recordings of the tests' own projector, and of the real ones."""

from dataclasses import replace
from functools import cache

import numpy as np
import projector
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.tools import verdict
from rs_localizer.tools.adjust.observe import Observed
from rs_localizer.tools.calibration import Calibration, calibrate
from rs_localizer.tools.first_lens import covered, first_lens
from rs_localizer.tools.readout_belief import discrepancy, examine

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


@pytest.fixture(scope="module")
def board() -> Calibration:
    return calibrate(CAMERA, list(recording()))


@pytest.fixture(scope="module")
def room() -> Calibration:
    return calibrate(CAMERA, list(recording(points="room", outliers=0.3, noise=0.5)))


@pytest.mark.parametrize("scene", ["board", "room"])
def test_readout_time_and_direction(scene, request):
    found = request.getfixturevalue(scene)
    agrees(found, 0.02, 1e-4)
    assert verdict.scan_direction(found) == "top_to_bottom"
    assert found.odds > 10.0
    assert found.jitter == 0.0
    assert verdict.refusal(found) == ""


def test_the_reversed_direction_is_found_and_images_without_the_board_are_not_missing():
    images = list(recording(-0.02))
    nothing = np.zeros((0, 3)), np.zeros((0, 2))
    images[30:33] = [Observed(image.stamp_ns, *nothing) for image in images[30:33]]
    found = calibrate(CAMERA, images)
    agrees(found, -0.02, 1e-4)
    assert verdict.scan_direction(found) == "bottom_to_top"
    assert found.stamps.missing == 0
    assert found.images == len(images) - 3


def test_corners_that_are_held_and_regions_that_are_empty_are_named(board):
    """A board whose shape is free is worth no word, one with too many corners is."""
    assert board.held == 0
    flat, stranger = projector.board(), np.ones((1, 3))
    shape = verdict.moved(board, np.concatenate([stranger, flat[::-1]]))
    np.testing.assert_array_equal(shape[:1], stranger)
    np.testing.assert_allclose(shape[1:], flat[::-1], atol=2e-3)
    assert np.all(np.any(shape[1:] != flat[::-1], axis=1))
    found, seen = board, board.posed.observations
    large = replace(seen, landmarks=np.zeros((500, 3)), points=np.zeros(15_000, dtype=np.int64))
    held = replace(
        found,
        posed=replace(found.posed, observations=large),
        fit=replace(found.fit, freedom=replace(found.fit.freedom, landmarks=0.0)),
    )
    assert held.held == 500
    assert any("map's 500 points" in remark for remark in verdict.remarks(held))
    above = seen.subset(seen.pixels[:, 1] < projector.HEIGHT / 2)
    part = replace(found, posed=replace(found.posed, observations=above))
    share, *regions = verdict.uncovered(part)
    assert {"bottom left", "bottom", "bottom right"} <= set(regions)
    assert any(f"never showed the map: {share}" in remark for remark in verdict.remarks(part))


def test_a_global_shutter_is_one():
    found = calibrate(CAMERA, list(recording(0.0)))
    assert found.global_shutter
    assert abs(found.readout_time) < 3.0 * found.deviation < 3e-4
    assert verdict.readout_time(found) == 0.0
    assert "global shutter" in " ".join(verdict.remarks(found))
    # Even stamps of a file prove nothing: what turned or re-timed the images has made them.
    processed = replace(found, own_stamps=False)
    assert "no proof of a global shutter" in verdict.refusal(processed)
    assert verdict.readout_time(replace(processed, readout_time=0.004)) == 0.004


def test_a_camera_at_rest_determines_nothing():
    found = calibrate(CAMERA, list(recording(0.02, turn=1e-5, seconds=1.2)))
    assert not found.determined
    assert "not observable" in verdict.refusal(found)


def test_irregular_stamps_are_noticed_and_do_little_harm():
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


def test_a_picture_that_is_turned_after_the_fact_makes_parts_disagree():
    """Stabilisation: a part of the motion is taken out of the images, more or less of it."""
    images = list(recording(0.02, seconds=1.0)) + [
        replace(image, stamp_ns=image.stamp_ns + 10**10)
        for image in recording(0.008, seconds=1.0, seed=22)
    ]
    found = calibrate(CAMERA, images)
    assert found.stabilised
    assert "stabilisation" in verdict.refusal(found)
    assert not any("times less likely" in remark for remark in verdict.remarks(found))


def test_what_nothing_can_contradict_or_no_camera_has_is_refused(board):
    found = board
    # A part that does not determine it as well as the whole must is no witness.
    vague = tuple(replace(block, deviation=0.06 / 30.0) for block in found.blocks[1:])
    short = replace(found, blocks=(found.blocks[0], *vague))
    assert f"1 of {len(found.blocks)} parts" in verdict.refusal(short)
    assert "longer than the interval" in verdict.refusal(replace(found, readout_time=0.04))
    fit = found.fit
    off = replace(fit.camera, K=fit.camera.K + np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 5e3]))
    assert "outside the image" in verdict.refusal(replace(found, fit=replace(fit, camera=off)))
    assert "off their stamps" in verdict.refusal(replace(found, jitter=1.1e-3))
    # No rolling shutter takes a millisecond; a camera that stamps its images is to be believed.
    fast = replace(found, readout_time=1e-3, deviation=1e-4)
    assert verdict.refusal(fast) == ""
    assert "no rolling shutter is that fast" in verdict.refusal(replace(fast, own_stamps=False))


def test_a_whole_that_lies_beside_all_of_its_parts_is_known_less_well():
    parts, deviations = np.array([1.0, 1.2, 1.1]), np.full(3, 0.1)
    assert discrepancy(1.15, parts, deviations) == 0.0  # within the noise of their mean
    assert discrepancy(2.1, parts, deviations) == pytest.approx(np.sqrt(1.0 - 0.01 / 3.0))
    assert discrepancy(2.1, parts[:0], deviations[:0]) == 0.0


@pytest.mark.parametrize(
    ("model", "deep"), [("equidistant", False), ("equidistant", True), ("plumb_bob", False)]
)
def test_the_distortion_model_is_that_of_the_lens(model, deep):
    """A fisheye of 150 degrees that shows a board, or a heap, in every direction; and an ordinary
    lens.
    """
    rng, flat = np.random.default_rng(2), projector.board(8, 6, 0.05, 0.0)
    if deep:  # OpenCV's calibration of fisheyes takes boards only, and no lens was found
        flat = flat + rng.uniform(-0.1, 0.1, flat.shape)
    camera = CAMERA
    if model == "equidistant":
        K, D = np.diag([240.0, 241.0, 1.0]), np.array([0.02, -0.01, 0.003, 0.0])
        K[:2, 2] = 321.0, 238.0
        camera = replace(camera, K=K, D=D, distortion_model=model)
    images = []
    while len(images) < 16:
        aside = rng.uniform(-1.0, 1.0, 2) * (1.1 if model == "equidistant" else 0.4)
        turn = Rotation.from_rotvec([*rng.normal(0.0, 0.4, 2), rng.uniform(-1.0, 1.0)])
        there = Rotation.from_rotvec([-aside[1], aside[0], 0.0]).apply([0.0, 0.0, 0.45])
        pixels = camera.project(turn.apply(flat) + there) + rng.normal(0.0, 0.1, (len(flat), 2))
        if np.all(camera.inside(pixels)):
            images.append(Observed(10**9 + 10**8 * len(images), flat, pixels))
    found = first_lens(camera.size, images)
    assert found.distortion_model == model
    corner = np.array([[0.8, 0.6]]) if model == "equidistant" else np.array([[0.5, 0.4]])
    np.testing.assert_allclose(found.distort(corner)[0], camera.distort(corner)[0], atol=1.0)


def test_a_fisheye_that_moves_fast_is_found_where_a_plain_lens_leaves_out_its_rim(monkeypatch):
    """A first lens, from images that move, is a plain one that fits the middle of the image."""
    K, k = np.array([[200.0, 0.0, 320.0], [0.0, 200.0, 240.0], [0.0, 0.0, 1.0]]), (-0.012, 0.002)

    def project(motion, t, points):
        rotations, centres = motion.pose(t)
        local = np.einsum("nji,nj->ni", rotations, points - centres)
        angle = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        radius = angle * (1.0 + k[0] * angle**2 + k[1] * angle**4)
        unit = local[:, :2] / np.hypot(local[:, 0], local[:, 1])[:, None]
        return 200.0 * radius[:, None] * unit + K[:2, 2]

    monkeypatch.setattr(projector, "project", project)
    rng = np.random.default_rng(3)
    motion, board = projector.Motion.random(rng, 0.2, 0.04), projector.board(8, 6, 0.08, 0.0)
    board = board - board.mean(axis=0) + [0.0, 0.0, 0.22]
    frames = projector.record(rng, motion, board, readout=0.02, seconds=1.5, noise=0.1)
    images = [Observed(round(1e9 * f.stamp), f.points, f.pixels) for f in frames]
    plain = Camera(projector.WIDTH, projector.HEIGHT, K, D=np.array([-0.33, 0.15, 0, 0, -0.04]))
    found = calibrate(plain, images, intrinsics=True)
    assert found.fit.camera.distortion_model == "equidistant"
    assert found.fit.camera.D[:2] == pytest.approx(k, abs=1e-3)
    assert abs(found.readout_time - 0.02) < 4.0 * found.deviation


def test_stamps_of_an_even_camera_with_missing_images():
    times = np.delete(np.arange(100) / 30.0, [10, 11, 50])
    found = examine(times)
    assert found.interval == pytest.approx(1 / 30, rel=1e-9)
    assert found.missing == 3
    assert not found.irregular
    rng = np.random.default_rng(0)
    assert examine(times + 7e-4 * rng.normal(size=len(times))).irregular


def test_what_images_cover_together():
    left = np.array([[0.0, 0.0], [319.0, 0.0], [319.0, 479.0], [0.0, 479.0]])
    assert covered((640, 480), [np.zeros((0, 2))]) == 0.0
    assert covered((640, 480), [left]) == pytest.approx(0.5, abs=0.02)
    right = left + np.array([320.0, 0.0])
    assert covered((640, 480), [left, right]) == 1.0
