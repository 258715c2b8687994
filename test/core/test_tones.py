"""Tones as polynomials of the row time: against the waves themselves."""

import numpy as np
import pytest

from rs_localizer.core.shake import shake_at
from rs_localizer.core.tones import MOST_CYCLES, degrees_for, tone_coefficients, tone_slopes

TAU = np.linspace(-0.5, 0.5, 201)


@pytest.mark.parametrize("cycles", [0.5, 1.0, 2.3, 6.0, MOST_CYCLES])
def test_the_polynomials_are_the_wave_less_what_is_the_motions(cycles):
    coefficients = np.zeros((degrees_for(cycles) - 1, 3))
    coefficients[:, :2] = tone_coefficients(cycles, degrees_for(cycles))
    followed, angle = shake_at(TAU, coefficients), 2.0 * np.pi * cycles * TAU
    np.testing.assert_allclose(followed[:, 0], np.cos(angle) - 1.0, atol=4e-3)
    np.testing.assert_allclose(followed[:, 1], np.sin(angle) - angle, atol=4e-3)


def test_slopes_are_derivatives_by_the_cycles():
    step = 1e-6
    difference = tone_coefficients(3.0 + step, 20) - tone_coefficients(3.0 - step, 20)
    np.testing.assert_allclose(tone_slopes(3.0, 20), difference / (2.0 * step), atol=1e-6)
