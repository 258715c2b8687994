# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames together say of how much a camera shakes and how far its map is off."""

import numpy as np
import pytest

from rs_localizer.core.scales import SPEEDS, VIBRATIONS, Scales, joined


def says(mean, precision, shakes=0.0, speeds=0.0):
    vibrations = shakes * (np.arange(VIBRATIONS) > 0)
    return Scales(np.array([mean, precision]), vibrations, speeds * np.ones(len(SPEEDS)))


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
