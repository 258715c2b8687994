"""Whether a tone shakes the camera, and what that makes of its motion.

A first look at all frequencies (:func:`.spectrum.loudest`) leaves few frames that need more: their
spectrum says how probable a tone is, the best tones are fitted (:mod:`.tones`), and what is not
decided, which of them or none, is averaged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.state import PARAMETERS, step_between
from rs_localizer.core.tones import degrees_for
from rs_localizer.estimation.columns import columns_of, with_prior
from rs_localizer.estimation.evidence import evidence_of_sizes, project_out
from rs_localizer.estimation.mixture import Inliers
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import GATE, Posterior
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.spectrum import CYCLES, SWINGS, spectrum
from rs_localizer.estimation.tones import FEWEST, PARAMETERS_OF_TONE, Start, Tone, fitted

# Power of the loudest tone that noise exceeds in one frame of twelve.
_LOUD = 16.5
# Points beyond the gate within so many inlier thresholds; so many, and such a part of the inliers,
# that random matches seldom lie there.
_NEAR = 16.0
_FEWEST_STRANGERS, _STRANGERS = 4, 0.1
_WIDE = 3.5  # times the median error, of the points among which tones are looked for
# Part of all shaking that tones are.
_TONAL = 0.5
_IMPROBABLE, _CERTAIN = 0.1, 0.98
# Logarithm of the odds beside the best tone, beyond which none counts.
_FAR_LESS_PROBABLE = 6.0
_MOST_TONES = 3
_ALIKE = 0.1  # cycles
_OUTLIERS = 0.1  # what part of the points may be wrong, a priori


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """The tones of a frame."""

    tones: list[Tone]
    probabilities: Array  # of each
    none: float  # probability that there is none

    @property
    def certain(self) -> bool:
        """Whether there is one."""
        return self.none < 1.0 - _CERTAIN


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """The points of a frame among which tones are looked for."""

    chosen: BoolArray  # (n,)
    gate: float  # px
    noise: float  # px


def hear(
    frame: Inliers, best: Posterior, loudness: float, threshold: float
) -> Heard | None:
    """The tones that may shake the camera, if they are not improbable.

    Args:
        best: the motion without one.
        loudness: of its errors, see :func:`rs_localizer.estimation.spectrum.loudest`.
        threshold: px, of inliers.
    """
    near = _near(best, threshold)
    strangers = np.count_nonzero(near.chosen) - np.count_nonzero(best.inliers)
    if np.count_nonzero(near.chosen) < FEWEST:
        return None
    if loudness < _LOUD and strangers <= 0:
        return None
    evidence, beside_field = _evidence(frame, best.state, near)
    tonal = _TONAL * (1.0 - float(frame.shake_prior[0]))
    odds = math.log(tonal / (1.0 - tonal)) + _mean(evidence[:, 1:] - evidence[0, 0]) - beside_field
    if odds < math.log(_IMPROBABLE):
        return None
    tones = _tones(frame, best, near, evidence, threshold)
    if not tones:
        return None
    found = np.array([_evidence_of(tone, frame.terms, threshold) for tone in tones])
    if strangers > 0:
        # Points far off count for more than they should.
        odds = min(odds, float(found.max()) - _evidence_of_none(best, frame.terms, threshold))
    none = 1.0 / (1.0 + math.exp(min(odds, 500.0)))
    if none > 1.0 - _IMPROBABLE:
        return None
    weights = np.exp(found - found.max())
    return Heard(tones, (1.0 - none) * weights / weights.sum(), none)


def _near(best: Posterior, threshold: float) -> _Near:
    """The inliers, and what lies beyond if that is more than chance."""
    lengths = np.sqrt(best.squared_errors)
    near = lengths < _NEAR * threshold
    inliers = np.count_nonzero(best.inliers)
    strangers = np.count_nonzero(near) - inliers
    chosen = best.inliers
    gate = float(lengths[chosen].max(initial=threshold))
    noise = best.noise
    if strangers > max(_FEWEST_STRANGERS, _STRANGERS * inliers):
        gate = min(max(2.0 * gate, _WIDE * float(np.median(lengths[near]))), _NEAR * threshold)
        chosen = lengths < gate
        noise = math.sqrt(0.5 * float(np.mean(best.squared_errors[chosen])))
    return _Near(chosen, gate, noise)


def _evidence(frame: Inliers, state: Array, near: _Near) -> tuple[Array, float]:
    """Evidence (m,s) of tones, and how much a smooth field explains."""
    observations, count = frame.observations, len(frame.observations)
    errors, by_motion, by_turn, tau = linearized(
        observations.packed, count, state, observations.row_time_gradient, np.zeros((count, 6))
    )
    columns = columns_of(
        errors, by_motion, by_turn, tau, observations.rays, near.chosen, 0, True
    )
    columns = with_prior(columns, frame.terms, state, near.noise)
    freedom = max(2.0 * np.count_nonzero(near.chosen) - 6.0, 1.0)
    field = project_out(
        columns.products, columns.with_errors, columns.squared_errors,
        len(columns.with_errors) - PARAMETERS,
    )  # fmt: skip
    of_field, _ = evidence_of_sizes(field, frame.field_sizes, freedom, near.noise)
    motion = columns._replace(
        products=np.ascontiguousarray(columns.products[:PARAMETERS, :PARAMETERS]),
        with_errors=columns.with_errors[:PARAMETERS].copy(),
    )
    evidence = spectrum(
        errors, by_motion, by_turn, tau, near.chosen, motion, freedom, near.noise
    )
    gain = float(np.logaddexp.reduce(np.log(frame.field_prior) + of_field - of_field[0]))
    return evidence, max(gain, 0.0)


def _mean(evidence: Array) -> float:
    return float(np.logaddexp.reduce(evidence, axis=None)) - math.log(evidence.size)


def _tones(
    frame: Inliers, best: Posterior, near: _Near, evidence: Array, threshold: float
) -> list[Tone]:
    """The tones at the highest peaks of the spectrum."""
    of_cycles = evidence.max(axis=1)
    padded = np.concatenate([[-np.inf], of_cycles, [-np.inf]])
    peaks = np.flatnonzero((of_cycles >= padded[:-2]) & (of_cycles > padded[2:]))
    peaks = peaks[of_cycles[peaks] > of_cycles.max() - _FAR_LESS_PROBABLE]
    tones: list[Tone] = []
    for peak in peaks[np.argsort(-of_cycles[peaks])][:_MOST_TONES]:
        size = float(SWINGS[max(int(np.argmax(evidence[peak])), 1)])
        start = Start(best.state, float(CYCLES[peak]), size, near.gate, near.noise)
        tone = fitted(frame.observations, start, frame.terms, threshold)
        if tone and all(abs(tone.cycles - other.cycles) > _ALIKE for other in tones):
            tones.append(tone)
    return tones


def _evidence_of(tone: Tone, terms: PriorTerms, threshold: float) -> float:
    """Logarithm of the marginal likelihood (Laplace's approximation)."""
    known = 0.5 * float(np.sum(tone.swings**2)) / tone.size**2
    known += 3.0 * math.log(2.0 * math.pi * tone.size**2) + math.log(CYCLES[-1] - CYCLES[0])
    known += 0.5 * tone.prior_cost
    return _likelihood(tone.squared_errors, tone.noise, threshold) - known + _volume(tone.covariance)


def _evidence_of_none(best: Posterior, terms: PriorTerms, threshold: float) -> float:
    cost = add_prior(
        *terms, best.state, 1.0, np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    )
    likelihood = _likelihood(best.squared_errors, best.noise, threshold)
    return likelihood - 0.5 * cost + _volume(best.covariance)


def _likelihood(squared_errors: Array, noise: float, threshold: float) -> float:
    """Of noise (px) and a part of outliers anywhere near."""
    variance = noise * noise
    right = np.exp(-0.5 * np.minimum(squared_errors, 1e9) / variance) / (2.0 * math.pi * variance)
    wrong = 1.0 / (math.pi * (_NEAR * threshold) ** 2)
    return float(np.sum(np.log((1.0 - _OUTLIERS) * right + _OUTLIERS * wrong)))


def _volume(covariance: Array) -> float:
    deviations = np.sqrt(np.diag(covariance))
    _, volume = np.linalg.slogdet(covariance / np.outer(deviations, deviations))
    return float(0.5 * volume + np.sum(np.log(math.sqrt(2.0 * math.pi) * deviations)))


def averaged(observations, heard: Heard, found: Posterior | None, best: Posterior) -> Posterior:
    """The mean of all tones and of the motion without one."""
    degrees = max(degrees_for(tone.cycles) for tone in heard.tones)
    size = PARAMETERS + 3 * (degrees - 1)
    reference = heard.tones[0].state
    steps, covariances, weights = [], [], list(heard.probabilities)
    for tone in heard.tones:
        by = tone.by_parameters(degrees)
        steps.append(
            np.concatenate([step_between(reference, tone.state), tone.coefficients(degrees).ravel()])
        )
        freedom = max(2.0 * np.count_nonzero(tone.inliers) - len(tone.covariance), 6.0)
        covariances.append(freedom / (freedom - 5.0) * by @ tone.covariance @ by.T)
    if found is not None:
        step, covariance = np.zeros(size), np.zeros((size, size))
        step[:PARAMETERS] = step_between(reference, found.state)
        kept = min(len(found.covariance), size)
        count = found.shake.size
        step[PARAMETERS : PARAMETERS + count] = found.shake.ravel()
        covariance[:kept, :kept] = found.covariance
        steps.append(step)
        covariances.append(covariance)
        weights.append(heard.none)
    probabilities = np.array(weights) / np.sum(weights)
    mean = probabilities @ np.array(steps)
    covariance = np.zeros((size, size))
    for p, step, one in zip(probabilities, steps, covariances, strict=True):
        covariance += p * (one + np.outer(step - mean, step - mean))
    loudest = heard.tones[int(np.argmax(heard.probabilities))]
    source = found if found is not None and heard.none > 0.5 else loudest
    return replace(
        best if found is None else found,
        state=apply_step(reference, mean[:PARAMETERS]),
        covariance=covariance,
        shake=mean[PARAMETERS:].reshape(-1, 3),
        noise=source.noise,
        squared_errors=source.squared_errors,
        inliers=source.inliers,
    )
