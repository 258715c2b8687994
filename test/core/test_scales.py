# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames together say of how much a camera shakes."""

import numpy as np
import pytest

from rs_localizer.core.scales import SCALES, SPEEDS, Scales, joined


def says(mean, precision, excess=0.0, speeds=0.0):
    every = np.ones(SCALES)
    return Scales(mean * every, precision * every, excess * every, speeds * np.ones(len(SPEEDS)))


def test_no_frame_says_nothing_and_adds_nothing():
    nothing = Scales.nothing()
    for part in joined(nothing, nothing):
        assert not part.any()
    # One frame, and then frames that say nothing of scales: the mean stays, as it is forgotten.
    known = joined(nothing, says(-6.0, 2.0))
    np.testing.assert_allclose(known.means, -6.0)
    np.testing.assert_allclose(known.precisions, 0.3 * 2.0)  # frames of a second are alike
    later = joined(known, nothing)
    np.testing.assert_allclose(later.means, -6.0)
    assert np.all(later.precisions < known.precisions)


def test_two_frames_are_weighed_by_their_precisions_the_newest_the_most():
    first = joined(Scales.nothing(), says(-6.0, 2.0))
    both = joined(first, says(-4.0, 2.0))
    assert np.all((both.means > -5.0) & (both.means < -4.9))
    assert np.all((both.precisions > 0.6) & (both.precisions < 1.2))


def test_a_camera_that_begins_to_shake_is_soon_known_to_and_forgotten():
    known = Scales.nothing()
    for _ in range(200):
        known = joined(known, says(-9.0, 3.0))
    # Half of what is known is forgotten within half a second of video.
    changed = [known := joined(known, says(-5.0, 3.0)) for _ in range(30)]
    halfway = next(k for k, each in enumerate(changed) if each.means[0] > -7.0)
    assert 5 <= halfway <= 20
    for _ in range(400):
        known = joined(known, Scales.nothing())
    assert known.precisions.max() < 1e-6


def test_excess_of_chance_stays_chance_and_what_is_shared_adds_up():
    rng, known, spread = np.random.default_rng(0), Scales.nothing(), []
    for _ in range(4000):
        known = joined(known, Scales.nothing()._replace(excess=rng.normal(size=SCALES)))
        spread.append(known.excess)
    assert np.std(spread[200:]) == pytest.approx(1.0, abs=0.1)
    known = Scales.nothing()
    for _ in range(30):
        known = joined(known, says(0.0, 0.0, excess=1.0))
    assert known.excess.min() > 3.3  # half of a deviation in each frame would never be looked at


def test_what_frames_agree_on_settles():
    """Scales to a tenth, as they wander; speeds as a third of ten frames."""
    known = Scales.nothing()
    for _ in range(300):
        known = joined(known, says(-5.0, 50.0, speeds=-2.0))
    assert known.precisions.max() == pytest.approx(100.0)
    np.testing.assert_allclose(known.speeds, -2.0 * 0.3 / (1.0 - 0.9))
