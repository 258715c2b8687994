# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames together say of how much a camera shakes and how far its map is off."""

import numpy as np
import pytest

from rs_localizer.core.scales import FACTORS, SPECTRA, SPEEDS, VIBRATIONS, Scales, joined


def says(mean, precision, shakes=0.0, speeds=0.0):
    vibrations = shakes * (np.arange(VIBRATIONS) > 0)
    return Scales(np.array([mean, precision]), vibrations, speeds * np.ones(len(SPEEDS)))


def test_all_spectra_are_as_strong():
    assert len(SPECTRA) * len(FACTORS) + 1 == VIBRATIONS
    strengths = np.square(SPECTRA).sum(axis=1)
    np.testing.assert_allclose(strengths, strengths[0])


def test_no_frame_says_nothing_and_adds_nothing():
    nothing = Scales.nothing()
    for part in joined(nothing, nothing):
        assert not part.any()
    # One frame, and then frames that say nothing: the mean stays, as it is forgotten.
    known = joined(nothing, says(-6.0, 2.0))
    np.testing.assert_allclose(known.size, [-6.0, 0.3 * 2.0])  # frames of a second are alike
    later = joined(known, nothing)
    assert later.size[0] == pytest.approx(-6.0)
    assert later.size[1] < known.size[1]


def test_two_frames_are_weighed_by_their_precisions_the_newest_the_most():
    first = joined(Scales.nothing(), says(-6.0, 2.0))
    mean, precision = joined(first, says(-4.0, 2.0)).size
    assert -5.0 < mean < -4.9
    assert 0.6 < precision < 1.2


def test_a_map_that_is_bent_is_soon_known_to_be_and_forgotten():
    known = Scales.nothing()
    for _ in range(200):
        known = joined(known, says(-9.0, 3.0))
    # Half of what is known is forgotten within half a second of video.
    changed = [known := joined(known, says(-5.0, 3.0)) for _ in range(30)]
    halfway = next(k for k, each in enumerate(changed) if each.size[0] > -7.0)
    assert 5 <= halfway <= 20
    for _ in range(400):
        known = joined(known, Scales.nothing())
    assert known.size[1] < 1e-6


def test_what_frames_agree_on_settles():
    """Sizes to a tenth, as they wander; speeds as a third of ten frames; of shaking, however many
    calm frames leave it possible.
    """
    known = Scales.nothing()
    for _ in range(300):
        known = joined(known, says(-5.0, 50.0, shakes=-3.0, speeds=-2.0))
    assert known.size[1] == pytest.approx(100.0)
    np.testing.assert_allclose(known.speeds, -2.0 * 0.3 / (1.0 - 0.9))
    assert known.vibrations[0] == 0.0
    np.testing.assert_allclose(known.vibrations[1:], -9.0)
    for _ in range(10):
        known = joined(known, says(-5.0, 50.0, shakes=10.0))
    assert known.vibrations[1:].min() > known.vibrations[0]
