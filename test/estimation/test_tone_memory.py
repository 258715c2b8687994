"""Tones that hide in the noise of one frame, and what many say of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.honesty.estimating import believed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import simulate
from benchmarks.independent.motions import hand, vibration
from benchmarks.independent.scenes import Rich
from rs_localizer.estimation.spectrum import CYCLES, SWINGS
from rs_localizer.estimation.tone_memory import leaning, with_frame
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

SHAPE = (len(CYCLES), len(SWINGS) - 1)
NOTHING = np.zeros(5)


def says(likelihood, field=NOTHING):
    return SimpleNamespace(of_tones=likelihood, of_field_sizes=field, of_shake_sizes=np.zeros(6))


def one(value):
    likelihood = np.full(SHAPE, -2.0)
    likelihood[20, 2] = value
    return likelihood


def probability(odds):
    return 1.0 / (1.0 + np.exp(-np.logaddexp.reduce(odds, axis=None)))


def test_who_says_nothing_leaves_even_odds():
    odds = with_frame(None, says(np.zeros(SHAPE)))
    for _ in range(5):
        odds = with_frame(odds, says(np.zeros(SHAPE)))
    assert probability(odds) == pytest.approx(0.5)
    np.testing.assert_allclose(leaning(odds), 0.0, atol=1e-12)
    assert with_frame(odds, says(np.zeros((0, 0)))) is odds


def test_one_step_is_that_of_the_forward_algorithm():
    """Against the products of probabilities themselves, all states in one row."""
    rng = np.random.default_rng(0)
    likelihoods = rng.normal(size=(2, *SHAPE))
    start = np.append(np.full(np.prod(SHAPE), 0.5 / np.prod(SHAPE)), 0.5)
    change = 0.02 * np.tile(start, (len(start), 1)) + 0.98 * np.eye(len(start))
    state = start
    for likelihood in likelihoods:
        state = (state * np.append(np.exp(likelihood).ravel(), 1.0)) @ change
        state /= state.sum()
    odds = with_frame(with_frame(None, says(likelihoods[0])), says(likelihoods[1]))
    np.testing.assert_allclose(odds.ravel(), np.log(state[:-1] / state[-1]), atol=1e-9)


def test_many_frames_tell_what_one_does_not_and_it_is_forgotten():
    odds = with_frame(None, says(one(2.0)))
    assert probability(odds) < 0.5
    for _ in range(10):
        odds = with_frame(odds, says(one(2.0)))
    assert probability(odds) > 0.9
    assert np.unravel_index(np.argmax(odds), SHAPE) == (20, 2)
    for _ in range(10):
        odds = with_frame(odds, says(np.full(SHAPE, -2.0)))
    assert probability(odds) < 0.1
    for _ in range(3):  # soon heard again
        odds = with_frame(odds, says(one(8.0)))
    assert probability(odds) > 0.9


def test_what_map_and_lens_explain_is_no_tone():
    odds = None
    for _ in range(10):
        odds = with_frame(odds, says(one(4.0), field=np.array([0.0, 0.0, 9.0, 0.0, 0.0])))
    assert probability(odds) < 0.1


@pytest.mark.parametrize("shakes", [False, True])
def test_a_tracker_hears_in_a_second_what_hides_in_each_frame(shakes):
    def make(count, rng):
        return vibration(count, rng, 0.1, 100.0) if shakes else hand(count, rng)

    seen = simulate(Camera(), make, Rich(), 1, 25, 4)
    tracker = Tracker(Localizer(believed(seen.camera)))
    for frame in range(len(seen)):
        assert tracker.localize(seen.middle_ns(frame), *seen.seen(frame, 1.0))
    odds = tracker.prediction(seen.middle_ns(24) + 33_000_000).of_tones
    assert probability(odds) > 0.9 if shakes else probability(odds) < 0.5
    if shakes:
        heard = CYCLES[np.unravel_index(np.argmax(odds), SHAPE)[0]]
        assert heard == pytest.approx(100.0 * seen.camera.readout_time, abs=0.5)
