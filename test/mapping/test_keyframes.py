"""Keyframes: spaced by overlap, sharp, slow."""

from __future__ import annotations

import numpy as np

from rs_localizer.mapping.keyframes import choose_keyframes

SIZE = (640, 480)


def pan(steps: list[float]) -> np.ndarray:
    """Motions of a picture that goes so many px to the left from view to view."""
    motions = np.tile(np.eye(3), (len(steps), 1, 1))
    motions[:, 0, 2] = -np.array(steps)
    return motions


def test_overlap_spaces_them() -> None:
    steps = [0.0] + 99 * [10.0]
    chosen = choose_keyframes(pan(steps), np.ones(100), SIZE).chosen
    between = 10.0 * np.diff(chosen) / SIZE[0]
    assert np.all(between > 0.12)
    assert np.all(between <= 0.28 + 10.0 / SIZE[0])
    assert chosen[-1] > 80


def test_a_still_camera_gives_one() -> None:
    assert choose_keyframes(pan(50 * [0.0]), np.ones(50), SIZE).chosen.tolist() == [0]


def test_a_fast_camera_gives_all() -> None:
    chosen = choose_keyframes(pan([0.0] + 9 * [300.0]), np.ones(10), SIZE).chosen
    assert chosen.tolist() == list(range(10))


def test_turning_back_adds_nothing() -> None:
    """The picture swings by little, for ever: it never leaves the first one."""
    steps = [0.0] + 20 * [10.0, -10.0]
    assert len(choose_keyframes(pan(steps), np.ones(len(steps)), SIZE).chosen) == 1


def test_blurred_views_are_left_out() -> None:
    sharpness = np.ones(100)
    sharpness[::2] = 0.3
    found = choose_keyframes(pan([0.0] + 99 * [10.0]), sharpness, SIZE)
    assert np.array_equal(np.flatnonzero(found.blurred), np.arange(0, 100, 2))
    assert np.all(found.chosen[1:] % 2 == 1)


def test_slow_views_are_preferred() -> None:
    rng = np.random.default_rng(1)
    steps = rng.uniform(2.0, 40.0, 200)
    found = choose_keyframes(pan(steps.tolist()), np.ones(200), SIZE)
    speeds = np.maximum(steps, np.append(steps[1:], steps[-1]))
    assert np.median(speeds[found.chosen[1:]]) < np.median(speeds)


def test_a_lost_picture_begins_anew() -> None:
    motions = pan([0.0] + 39 * [1.0])
    motions[20] = np.nan
    found = choose_keyframes(motions, np.ones(40), SIZE)
    assert found.breaks.tolist() == [20]
    assert found.chosen.tolist() == [0, 20]
