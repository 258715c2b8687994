"""How probable tones are: against no tone, against each other, and against what looks like them."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.assumptions import SHAKE_PRIOR
from rs_localizer.estimation.columns import columns_of, with_prior
from rs_localizer.estimation.evidence import evidence_of_sizes, project_out
from rs_localizer.estimation.modes import Inliers
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.residuals import Lines
from rs_localizer.estimation.spectrum import CYCLES, spectrum
from rs_localizer.estimation.tone_memory import leaning
from rs_localizer.estimation.tones import Fit, Seen, Tones, products_of

NEAR = 16.0
"""How far off points may be that count as near, in inlier thresholds."""
# Part of all shaking that tones are.
_TONAL = 0.5
_LEAST_PROBABLE = 1e-6
_OUTLIERS = 0.1  # what part of the points may be wrong, a priori


def spectrum_of(frame: Inliers, tones: Tones, seen: Seen, chosen: BoolArray, noise: float) -> Array:
    """Evidence (m,s) of one tone more."""
    known, *_ = products_of(tones, seen, chosen, frame.terms, noise)
    freedom = max(2.0 * np.count_nonzero(chosen) - 6.0, 1.0)
    found: Array = spectrum(
        seen.errors, seen.columns, seen.by_turn, seen.tau, chosen, known, freedom, noise
    )
    return found


def leaned(frame: Inliers, evidence: Array) -> Array:
    """Evidence (m,s) with what the last frames say of each tone, if there is one."""
    if frame.assumed.of_tones is None:
        return evidence
    more = evidence.copy()
    more[:, 1:] += leaning(frame.assumed.of_tones)
    return more


def evidence_for(frame: Inliers, fit: Fit, threshold: float) -> float:
    """Logarithm of the marginal likelihood of the first tone alone, with what the last frames say
    of its frequency."""
    evidence = evidence_of(fit, threshold)
    if frame.assumed.of_tones is None:
        return evidence
    lean = leaning(frame.assumed.of_tones)[np.argmin(np.abs(CYCLES - fit.tones.cycles[0]))]
    return evidence + float(np.logaddexp.reduce(lean)) - math.log(len(lean))


def odds_of(frame: Inliers, evidence: Array) -> float:
    """Logarithm of the odds that there is a tone, of any frequency and size."""
    likelihood = float(np.logaddexp.reduce(evidence[:, 1:], axis=None) - evidence[0, 0])
    return likelihood - math.log(evidence[:, 1:].size) + prior_odds(frame)


def prior_odds(frame: Inliers) -> float:
    """Logarithm of the odds that there is a tone, before the points are asked."""
    odds, known = tonal_odds(float(frame.shake_prior[0])), frame.assumed.of_tones
    if known is None:
        return odds
    # What the last frames say of any shaking may make it more probable still.
    return float(np.logaddexp.reduce(known, axis=None)) - EVEN + max(odds + EVEN, 0.0)


def tonal_odds(no_shake: float) -> float:
    """Logarithm of the odds of a tone where no shaking is as probable as this."""
    tonal = max(_TONAL * (1.0 - no_shake), _LEAST_PROBABLE)
    return math.log(tonal / (1.0 - tonal))


EVEN = -tonal_odds(float(SHAKE_PRIOR[0]))
"""Logarithm of the odds by which a tone is more probable than the prior has it, for any camera,
where it is as probable as not."""


def gain_of_field(
    frame: Inliers, state: Array, seen: Seen, chosen: BoolArray, noise: float
) -> float:
    """Logarithm of how much better a smooth field of errors explains the points."""
    lines = Lines(seen.errors, seen.columns, seen.by_turn, seen.tau, seen.image)
    columns = columns_of(lines, chosen, 0, True)
    columns = with_prior(columns, frame.terms, state, noise)
    field = project_out(
        columns.products, columns.with_errors, columns.squared_errors,
        len(columns.with_errors) - PARAMETERS,
    )  # fmt: skip
    freedom = max(2.0 * np.count_nonzero(chosen) - 6.0, 1.0)
    evidence, _ = evidence_of_sizes(field, frame.field_sizes, freedom, noise)
    gains = np.log(frame.field_prior) + evidence - evidence[0]
    return max(float(np.logaddexp.reduce(gains)), 0.0)


def evidence_of(fit: Fit, threshold: float) -> float:
    """Logarithm of the marginal likelihood (Laplace's approximation)."""
    tones = fit.tones
    squares = np.sum(tones.swings**2, axis=(1, 2)) / tones.sizes**2
    volumes = 6.0 * np.log(2.0 * math.pi * tones.sizes**2) / 2.0
    known = np.sum(0.5 * squares + volumes) + len(squares) * math.log(CYCLES[-1] - CYCLES[0])
    likelihood = _likelihood(fit.seen.squared_errors, fit.noise, threshold)
    return likelihood - float(known) - 0.5 * fit.prior_cost + _volume(fit.covariance)


def evidence_of_none(frame: Inliers, best: Posterior, threshold: float) -> float:
    unused = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost = float(add_prior(*frame.terms, best.state, 1.0, *unused))
    likelihood = _likelihood(best.squared_errors, best.noise, threshold)
    return likelihood - 0.5 * cost + _volume(best.covariance)


def _likelihood(squared_errors: Array, noise: float, threshold: float) -> float:
    """Of noise (px), and a part of outliers anywhere near."""
    variance = noise * noise
    right = np.exp(-0.5 * np.minimum(squared_errors, 1e9) / variance) / (2.0 * math.pi * variance)
    wrong = 1.0 / (math.pi * (NEAR * threshold) ** 2)
    return float(np.sum(np.log((1.0 - _OUTLIERS) * right + _OUTLIERS * wrong)))


def _volume(covariance: Array) -> float:
    deviations = np.sqrt(np.diag(covariance))
    _, volume = np.linalg.slogdet(covariance / np.outer(deviations, deviations))
    return float(0.5 * volume + np.sum(np.log(math.sqrt(2.0 * math.pi) * deviations)))
