"""A tone, shaking of one frequency, as polynomials of the row time.

A cosine and a sine of ``z x`` are series of Legendre polynomials, whose coefficients die out fast
beyond degree ``z`` (spherical Bessel functions; NIST Digital Library of Mathematical Functions,
10.60).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.shake import FIRST_DEGREE, basis_sizes

MOST_CYCLES = 8.0
"""Of a tone, in one readout."""
# Of the integrals that are the coefficients: exact to rounding for tones of so many cycles.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


def degrees_for(cycles: float) -> int:
    """Degree of the polynomials that follow a tone to a part in a thousand."""
    z = math.pi * cycles
    return math.ceil(z + 3.0 * math.cbrt(z) + 2.0)


@cache
def _polynomials(degrees: int) -> Array:
    """What the coefficients (k,) are of a function's values at the nodes: (k,64)."""
    values = np.polynomial.legendre.legvander(_NODES, degrees)[:, FIRST_DEGREE:]
    scale = (np.arange(FIRST_DEGREE, degrees + 1) + 0.5) / basis_sizes(degrees)
    of_values: Array = scale[:, None] * (values * _WEIGHTS[:, None]).T
    return of_values


def tone_coefficients(cycles: float, degrees: int) -> Array:
    """Coefficients (k,2) of ``cos(w tau) - 1`` and ``sin(w tau) - w tau``, w = 2 pi cycles.

    What is taken away at the middle row is the motion's, as of all shaking.
    """
    angle = math.pi * cycles * _NODES
    coefficients: Array = _polynomials(degrees) @ np.column_stack([np.cos(angle), np.sin(angle)])
    return coefficients


def tone_slopes(cycles: float, degrees: int) -> Array:
    """Derivatives (k,2) of the coefficients by the cycles."""
    angle, by_cycles = math.pi * cycles * _NODES, math.pi * _NODES
    slopes = [-by_cycles * np.sin(angle), by_cycles * np.cos(angle)]
    derivatives: Array = _polynomials(degrees) @ np.column_stack(slopes)
    return derivatives
