# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that are alike from image to image, and how much less they say."""

import numpy as np
import pytest

from rs_localizer.tools.adjust.fit import pull_at_landmarks

RATE, LANDMARKS, SECONDS = 30, 60, 10


def alike(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> np.ndarray:
    """Errors of variance 1 in time (the first axis): such a share of one image goes on."""
    fresh = rng.normal(size=shape)
    errors = fresh.copy()
    for k in range(1, len(errors)):
        errors[k] = share * errors[k - 1] + np.sqrt(1.0 - share**2) * fresh[k]
    return errors


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_what_errors_pull_at_landmarks_is_their_long_run_variance(share):
    rng = np.random.default_rng(0)
    times = np.repeat(np.arange(RATE * SECONDS) / RATE, LANDMARKS)
    landmarks = np.tile(np.arange(LANDMARKS), RATE * SECONDS)
    errors = alike(rng, (RATE * SECONDS, LANDMARKS, 2), share).reshape(-1, 2)
    first, last = rng.normal(size=(2, LANDMARKS, 2, 3))
    gone = (times / SECONDS)[:, None, None]
    own = (1.0 - gone) * first[landmarks] + gone * last[landmarks]
    # What is left of the errors, the landmarks estimated.
    left = np.empty_like(errors)
    for landmark in range(LANDMARKS):
        of = landmarks == landmark
        rows = own[of].reshape(-1, 3)
        fit = np.linalg.lstsq(rows, errors[of].ravel(), rcond=None)[0]
        left[of] = errors[of] - (rows @ fit).reshape(-1, 2)
    measured, expected = pull_at_landmarks(
        np.concatenate([own, left[..., None]], axis=2), landmarks, times, np.zeros(LANDMARKS)
    )
    assert measured / expected == pytest.approx((1.0 + share) / (1.0 - share), rel=0.2)
