"""What tones that shake a camera make of its motion: which of them or none is averaged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.state import PARAMETERS, step_between
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.refine import apply_step
from rs_localizer.estimation.tones import Fit

CERTAIN = 0.98
"""Probability from which on nothing else counts."""
FEW_TONES = 2
"""More than these may be any shaking."""


@dataclass(frozen=True, slots=True, eq=False)
class ToneMixture:
    """What may shake the camera."""

    fits: list[Fit]
    probabilities: Array  # of each
    none: float  # probability that it is none of them
    agreement: float  # of neighbouring rows beside the most probable one
    exhausted: bool  # whether further tones are likely, and the points too few to tell them

    @property
    def certain(self) -> bool:
        """Whether it is one of them."""
        return self.none < 1.0 - CERTAIN

    @property
    def tonal(self) -> bool:
        """Whether so few tones explain the frame that it can be nothing else."""
        return len(self.best.tones.cycles) <= FEW_TONES

    @property
    def best(self) -> Fit:
        """The most probable one."""
        return self.fits[int(np.argmax(self.probabilities))]


def room_for_more(fit: Fit) -> bool:
    """Whether there would be as many points as parameters with one tone more."""
    return len(fit.covariance) + 7 <= int(np.count_nonzero(fit.inliers))


class _Mode(NamedTuple):
    """One Gaussian."""

    probability: float
    state: Array  # (24,)
    shake: Array  # (k,3)
    covariance: Array  # (18 + 3 k, 18 + 3 k)


def averaged(mixture: ToneMixture, found: Posterior) -> Posterior:
    """The mean of all tones and, where these are not certain, of what was found without them."""
    modes = [_mode(*one) for one in zip(mixture.probabilities, mixture.fits, strict=True)]
    if not mixture.certain:
        modes.append(_Mode(mixture.none, found.state, found.shake, found.covariance))
    state, shake, covariance = _mean(modes)
    mixed = replace(found, state=state, shake=shake, covariance=covariance)
    if mixture.none >= 0.5:
        return mixed
    best = mixture.best
    return replace(
        mixed,
        noise=best.noise,
        squared_errors=best.seen.squared_errors,
        inliers=best.inliers,
        agreement=mixture.agreement,
        mirror=None,
    )


def _mode(probability: float, fit: Fit) -> _Mode:
    tones = fit.tones
    by_parameters = tones.by_parameters(tones.degrees)
    freedom = max(2.0 * np.count_nonzero(fit.inliers) - len(fit.covariance), 6.0)
    # The noise itself is an estimate, see :attr:`.posterior.Posterior.inflation`.
    covariance = freedom / (freedom - 5.0) * by_parameters @ fit.covariance @ by_parameters.T
    return _Mode(probability, tones.state, tones.coefficients(tones.degrees), covariance)


def _mean(modes: list[_Mode]) -> tuple[Array, Array, Array]:
    """State, shaking and covariance of a mixture."""
    size = max(len(mode.covariance) for mode in modes)
    probabilities = np.array([mode.probability for mode in modes])
    probabilities /= probabilities.sum()
    reference = modes[int(np.argmax(probabilities))].state
    steps, covariance = np.zeros((len(modes), size)), np.zeros((size, size))
    for step, mode, probability in zip(steps, modes, probabilities, strict=True):
        step[:PARAMETERS] = step_between(reference, mode.state)
        step[PARAMETERS : PARAMETERS + mode.shake.size] = mode.shake.ravel()
        count = len(mode.covariance)
        covariance[:count, :count] += probability * mode.covariance
    mean = probabilities @ steps
    offsets = steps - mean
    covariance += np.einsum("k,ki,kj->ij", probabilities, offsets, offsets)
    state = apply_step(reference, mean[:PARAMETERS])
    return state, mean[PARAMETERS:].reshape(-1, 3), covariance
