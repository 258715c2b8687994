"""Whether tones shake a camera.

A first look at all frequencies (:func:`.spectrum.loudest`) leaves few frames that need more. Of
these, the spectrum among all points that are near says how probable a tone is, the best tones are
fitted (:mod:`.tones`), and others follow as long as there are any.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.estimation.model_error import Examined
from rs_localizer.estimation.modes import Inliers
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.shaking import agreement_of
from rs_localizer.estimation.spectrum import CYCLES, SWINGS, loudest, spread_by_tones
from rs_localizer.estimation.tone_evidence import (
    EVEN,
    NEAR,
    evidence_for,
    evidence_of,
    evidence_of_none,
    gain_of_field,
    leaned,
    odds_of,
    prior_odds,
    spectrum_of,
)
from rs_localizer.estimation.tone_mixture import (
    CERTAIN,
    FEW_TONES,
    ToneMixture,
    room_for_more,
)
from rs_localizer.estimation.tones import FEWEST, Fit, Seen, Tones, fitted, seen_at

# Power of the loudest tone that noise seldom exceeds. Below it, good frames with chance matches
# were now and then taken for shaken.
_LOUD = 20.0
# So many points that are near, but no inliers, and such a part of the inliers: random matches
# seldom lie there.
_STRANGERS, _PART = 4, 0.1
# Among fewer inliers a motion alone leaves little of a tone to be heard, and strangers say more.
FEW = 40
"""Inliers, below which tones are hard to hear."""
_LOUD_OF_FEW = 9.0
_FEWEST_INLIERS = 6  # of a motion near which tones are looked for
_SWING = float(SWINGS[4])  # of tones that a spectrum does not show
_WIDE = 3.5  # times the median error, of the points among which tones are looked for
_IMPROBABLE = math.log(0.3)  # odds
# Logarithm of the odds from which on a tone, that the last frames told of, is looked for.
_TOLD = -1.0
# Logarithm of the odds beside the best tone, beyond which none counts.
_FAR_LESS_PROBABLE = 6.0
_ALTERNATIVES = 3
_ALIKE = 0.1  # cycles
# Tones of fewer cycles may as well be something else that is slow, which polynomials follow; but
# where they swing out of the gate, tones find the points again.
_SLOW = 1.75
_MOST_TONES = 6  # and no more parameters than points
# Power that tells of a further tone where there is no room for one.
_STILL_LOUD = 12.0
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
    few: bool  # inliers


class Heard(NamedTuple):
    """What is known of tones that may shake a camera."""

    mixture: ToneMixture | None  # if they are not improbable
    unheard: Array | None  # (18,18) what tones that hide in the noise add to the covariance


_SILENCE = Heard(None, None)


def warm_up() -> None:
    """Compile what only frames with a tone and few points, or more tones, come to."""
    loudest(np.zeros((1, 2)), np.zeros((1, 2, 3)), np.zeros(1), np.zeros(1, dtype=bool))


def find_tones(frame: Inliers, best: Posterior, examined: Examined, threshold: float) -> Heard:
    """The tones that may shake the camera.

    Args:
        best: the motion without one.
        examined: what it leaves of the image.
        threshold: px, of inliers.
    """
    inliers = np.count_nonzero(best.inliers)
    if inliers < _FEWEST_INLIERS:
        return _SILENCE
    few = bool(inliers < FEW)
    near = _near(best, few, threshold)
    loud = examined.tones.loudest >= (_LOUD_OF_FEW if few else _LOUD)
    if not (loud or near.strangers or _told(frame, examined)):
        return _SILENCE
    if np.count_nonzero(near.chosen) < FEWEST:
        return _SILENCE
    still = Tones.none(best.state)
    seen = seen_at(frame.observations, still)
    evidence = leaned(frame, spectrum_of(frame, still, seen, near.chosen, near.noise))
    odds, others = odds_of(frame, evidence), _of_others(frame, still, examined, seen, best)
    fits = list[Fit]()
    if near.strangers or odds - others > _IMPROBABLE:
        fits = _alternatives(frame, still, evidence, near, threshold)
    found = np.array([evidence_for(frame, fit, threshold) for fit in fits])
    if near.strangers:
        # Points far off count in a spectrum for more than they should.
        evidence = leaned(frame, spectrum_of(frame, still, seen, best.inliers, best.noise))
        odds = odds_of(frame, evidence)
        if fits:
            none = evidence_of_none(frame, best, threshold)
            odds = prior_odds(frame) + float(found.max()) - none
    odds -= others
    if not fits or odds < _IMPROBABLE:
        return Heard(None, _unheard(seen, best, evidence, odds))
    return Heard(_mixture(frame, fits, found, _probability(-odds), near, threshold), None)


def _told(frame: Inliers, examined: Examined) -> bool:
    """Whether the last frames and this one together tell of a tone."""
    before = frame.assumed.of_tones
    if before is None:
        return False
    return bool(np.logaddexp.reduce(before + examined.tones.likelihood, axis=None) > _TOLD)


def _unheard(seen: Seen, best: Posterior, evidence: Array, odds: float) -> Array | None:
    """What tones of this evidence (m,s) that hide in the noise add to the covariance (18,18);
    None where that cannot be computed."""
    added: Array = spread_by_tones(
        seen.errors, seen.columns, seen.by_turn, seen.tau, best.inliers, best.covariance,
        best.noise, evidence,
    )  # fmt: skip
    return _probability(odds + EVEN) * added if np.all(np.isfinite(added)) else None


def _probability(odds: float) -> float:
    """Of the logarithm of odds."""
    return 1.0 / (1.0 + math.exp(-min(max(odds, -500.0), 500.0)))


def _of_others(
    frame: Inliers, still: Tones, examined: Examined, seen: Seen, best: Posterior
) -> float:
    """How much better than noise alone map and lens, or slow shaking, explain the inliers."""
    field = gain_of_field(frame, still.beside, seen, best.inliers, best.noise)
    slow = np.logaddexp.reduce(np.log(frame.shake_prior) + examined.sizes.of_shake_sizes)
    # Polynomials follow what is slow only where there are points enough for them.
    few = np.count_nonzero(best.inliers) < FEW
    return field if few else max(field, float(slow))


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
    probabilities = (1.0 - none) * weights / weights.sum()
    return ToneMixture(fits, probabilities, none, agreement, _exhausted(best))


def _exhausted(fit: Fit) -> bool:
    """Whether there may be further tones, and the points are too few to look for them."""
    tones, seen = len(fit.tones.cycles), fit.seen
    if tones < FEW_TONES or room_for_more(fit):
        return False
    left = loudest(seen.errors, seen.by_turn, seen.tau, fit.inliers)
    return tones > FEW_TONES or left > _STILL_LOUD


def strangers_of(squared_errors: Array, inliers: BoolArray, threshold: float) -> int:
    """How many points lie near, but beyond the gate (threshold: px, of inliers)."""
    near = np.count_nonzero(squared_errors < (NEAR * threshold) ** 2)
    return int(near - np.count_nonzero(inliers))


def _near(best: Posterior, few: bool, threshold: float) -> _Near:
    """The inliers, and strangers where there are more than chance would put there."""
    lengths = np.sqrt(best.squared_errors)
    gate = float(lengths[best.inliers].max(initial=threshold))
    strangers = strangers_of(best.squared_errors, best.inliers, threshold)
    by_chance = 0.0 if few else max(_STRANGERS, _PART * np.count_nonzero(best.inliers))
    if strangers <= by_chance:
        return _Near(best.inliers, gate, best.noise, False, few)
    typical = float(np.median(lengths[lengths < NEAR * threshold]))
    gate = min(max(2.0 * gate, _WIDE * typical), NEAR * threshold)
    chosen = lengths < gate
    return _Near(chosen, gate, math.sqrt(0.5 * float(np.mean(lengths[chosen] ** 2))), True, few)


def _alternatives(
    frame: Inliers, still: Tones, evidence: Array, near: _Near, threshold: float
) -> list[Fit]:
    """The tones at the highest peaks of the spectrum."""
    of_cycles = evidence.max(axis=1)
    padded = np.concatenate([[-np.inf], of_cycles, [-np.inf]])
    peaks = np.flatnonzero((of_cycles >= padded[:-2]) & (of_cycles > padded[2:]))
    peaks = peaks[of_cycles[peaks] > of_cycles.max() - _FAR_LESS_PROBABLE]
    starts = [
        _with_peak(still, evidence, int(peak))
        for peak in peaks[np.argsort(-of_cycles[peaks])][:_ALTERNATIVES]
    ]
    fits = _distinct(frame, starts, [], near, threshold)
    if near.strangers and near.few and not _explained(fits, threshold):
        # A spectrum of errors beyond the gate may have its peaks anywhere.
        starts = [still.with_one(float(cycles), _SWING) for cycles in CYCLES[::2]]
        fits = _distinct(frame, starts, fits, near, threshold)
        best = max((evidence_of(fit, threshold) for fit in fits), default=0.0)
        fits = [f for f in fits if evidence_of(f, threshold) > best - _FAR_LESS_PROBABLE]
    return fits


def _explained(fits: list[Fit], threshold: float) -> bool:
    """Whether one of them leaves no strangers."""
    return any(
        strangers_of(fit.seen.squared_errors, fit.inliers, threshold)
        <= max(1.0, _PART * np.count_nonzero(fit.inliers))
        for fit in fits
    )


def _distinct(
    frame: Inliers, starts: list[Tones], fits: list[Fit], near: _Near, threshold: float
) -> list[Fit]:
    """These fits and those from other starts that are none of them."""
    fits = list(fits)
    for start in starts:
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
        if not room_for_more(fit):
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
