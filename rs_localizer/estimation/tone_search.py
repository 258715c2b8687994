"""Whether tones shake a camera.

A first look at all frequencies (:func:`.spectrum.loudest`) leaves few frames that need more. Of
these, the spectrum among all points that are near says how probable a tone is, the best tones are
fitted (:mod:`.tones`), and others follow as long as there are any.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.estimation.mixture import Inliers
from rs_localizer.estimation.model_error import Examined
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.shaking import agreement_of
from rs_localizer.estimation.spectrum import CYCLES, SWINGS, loudest
from rs_localizer.estimation.tone_evidence import (
    NEAR,
    evidence_of,
    evidence_of_none,
    gain_of_field,
    odds_of,
    spectrum_of,
)
from rs_localizer.estimation.tone_mixture import CERTAIN, ToneMixture
from rs_localizer.estimation.tones import FEWEST, Fit, Tones, fitted, seen_at

# Power of the loudest tone that noise exceeds in two or three frames of a hundred.
_LOUD = 20.0
# So many points that are near, but no inliers, and such a part of the inliers: random matches
# seldom lie there.
_FEWEST_STRANGERS, _STRANGERS = 4, 0.1
_WIDE = 3.5  # times the median error, of the points among which tones are looked for
_IMPROBABLE = 0.2
# Logarithm of the odds beside the best tone, beyond which none counts.
_FAR_LESS_PROBABLE = 6.0
_ALTERNATIVES = 3
_ALIKE = 0.1  # cycles
# Tones of fewer cycles may as well be something else that is slow, which polynomials follow; but
# where they swing out of the gate, tones find the points again.
_SLOW = 1.75
_MOST_TONES = 6  # and no more parameters than points
# Beside a tone another one is nothing strange: power from which on it is looked for, and logarithms
# of the odds that it has to gain to count alone, or at all.
_BESIDE, _FURTHER, _DOUBTFUL = 8.0, 3.0, math.log((1.0 - CERTAIN) / CERTAIN)


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """The points of a frame among which tones are looked for."""

    chosen: BoolArray  # (n,)
    gate: float  # px
    noise: float  # px
    strangers: bool  # whether some are no inliers


def find_tones(
    frame: Inliers, best: Posterior, examined: Examined, threshold: float
) -> ToneMixture | None:
    """The tones that may shake the camera, if they are not improbable.

    Args:
        best: the motion without one.
        examined: what it leaves of the image.
        threshold: px, of inliers.
    """
    strangers = _strangers(best, threshold)
    if examined.loudness < _LOUD and not strangers:
        return None
    near = _near(best, strangers, threshold)
    if np.count_nonzero(near.chosen) < FEWEST:
        return None
    still = Tones.none(best.state)
    evidence, odds = _first_look(frame, still, examined, near)
    if odds < math.log(_IMPROBABLE):
        return None
    fits = _alternatives(frame, still, evidence, near, threshold)
    if not fits:
        return None
    found = np.array([evidence_of(fit, threshold) for fit in fits])
    if near.strangers:
        # Points far off count for more than they should.
        odds = min(odds, float(found.max()) - evidence_of_none(frame, best, threshold))
    none = 1.0 / (1.0 + math.exp(min(odds, 500.0)))
    return None if none > 1.0 - _IMPROBABLE else _mixture(frame, fits, found, none, near, threshold)


def _first_look(
    frame: Inliers, still: Tones, examined: Examined, near: _Near
) -> tuple[Array, float]:
    """The spectrum (m,s), and the logarithm of the odds that tones are in it."""
    seen = seen_at(frame.observations, still)
    evidence = spectrum_of(frame, still, seen, near.chosen, near.noise)
    odds = odds_of(frame, evidence)
    if odds < math.log(_IMPROBABLE):
        return evidence, odds
    # Map and lens, or slow shaking, may explain as much.
    field = gain_of_field(frame, still.beside, seen, near.chosen, near.noise)
    slow = np.logaddexp.reduce(np.log(frame.shake_prior) + examined.sizes.of_shake_sizes)
    return evidence, odds - max(field, float(slow))


def _mixture(
    frame: Inliers, fits: list[Fit], found: Array, none: float, near: _Near, threshold: float
) -> ToneMixture:
    """The alternatives, of this evidence; or the best one and others beside it."""
    best = fits[int(np.argmax(found))]
    if none < 1.0 - CERTAIN:
        more = _with_others(frame, best, near, threshold)
        if more[0] is not best or len(more) > 1:
            best, fits = more[0], more
            found = np.array([evidence_of(fit, threshold) for fit in fits])
        elif best.tones.cycles[0] < _SLOW and not near.strangers:
            none = 0.5
    weights = np.exp(found - found.max())
    agreement = agreement_of(
        frame.observations, best.seen.errors, best.seen.squared_errors, best.inliers
    )
    return ToneMixture(fits, (1.0 - none) * weights / weights.sum(), none, agreement)


def _strangers(best: Posterior, threshold: float) -> bool:
    """Whether more lies just beyond the gate than chance would put there."""
    near = np.count_nonzero(best.squared_errors < (NEAR * threshold) ** 2)
    inliers = np.count_nonzero(best.inliers)
    return bool(near - inliers > max(_FEWEST_STRANGERS, _STRANGERS * inliers))


def _near(best: Posterior, strangers: bool, threshold: float) -> _Near:
    """The inliers, and strangers."""
    lengths = np.sqrt(best.squared_errors)
    gate = float(lengths[best.inliers].max(initial=threshold))
    if not strangers:
        return _Near(best.inliers, gate, best.noise, False)
    typical = float(np.median(lengths[lengths < NEAR * threshold]))
    gate = min(max(2.0 * gate, _WIDE * typical), NEAR * threshold)
    chosen = lengths < gate
    return _Near(chosen, gate, math.sqrt(0.5 * float(np.mean(lengths[chosen] ** 2))), True)


def _alternatives(
    frame: Inliers, still: Tones, evidence: Array, near: _Near, threshold: float
) -> list[Fit]:
    """The tones at the highest peaks of the spectrum."""
    of_cycles = evidence.max(axis=1)
    padded = np.concatenate([[-np.inf], of_cycles, [-np.inf]])
    peaks = np.flatnonzero((of_cycles >= padded[:-2]) & (of_cycles > padded[2:]))
    peaks = peaks[of_cycles[peaks] > of_cycles.max() - _FAR_LESS_PROBABLE]
    fits: list[Fit] = []
    for peak in peaks[np.argsort(-of_cycles[peaks])][:_ALTERNATIVES]:
        start = _with_peak(still, evidence, int(peak))
        fit = fitted(frame.observations, start, near.gate, frame.terms, threshold)
        if fit and all(abs(fit.tones.cycles[0] - f.tones.cycles[0]) > _ALIKE for f in fits):
            fits.append(fit)
    return fits


def _with_peak(tones: Tones, evidence: Array, peak: int) -> Tones:
    size = SWINGS[max(int(np.argmax(evidence[peak])), 1)]
    return tones.with_one(float(CYCLES[peak]), float(size))


def _with_others(frame: Inliers, fit: Fit, near: _Near, threshold: float) -> list[Fit]:
    """The tones and all others that are found beside them; then with what may be one more."""
    evidence = evidence_of(fit, threshold)
    while len(fit.tones.cycles) < _MOST_TONES:
        seen = fit.seen
        if len(fit.covariance) + 7 > np.count_nonzero(fit.inliers):
            break
        if loudest(seen.errors, seen.by_turn, seen.tau, fit.inliers) < _BESIDE:
            break
        louder = spectrum_of(frame, fit.tones, seen, fit.inliers, fit.noise)
        peak = int(np.argmax(louder.max(axis=1)))
        start = _with_peak(fit.tones, louder, peak)
        further = fitted(frame.observations, start, near.gate, frame.terms, threshold)
        if further is None:
            break
        gained = evidence_of(further, threshold)
        if gained < evidence + _FURTHER:
            return [fit, further] if gained > evidence + _DOUBTFUL else [fit]
        fit, evidence = further, gained
    return [fit]
