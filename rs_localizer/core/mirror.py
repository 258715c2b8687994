"""Planes show two poses: the one that is mirrored about the line of sight may fit as well.

From far away, or on a small marker, a plane that leans to the left and one that leans to the right
look alike but for perspective (Schweighofer, Pinz, "Robust pose estimation from a planar target",
PAMI 2006). A minimum that was found says nothing of the other one, so it is looked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.posterior import (
    Mirror,
    Posterior,
    evidence_of_motion,
    fit,
    maximum_a_posteriori,
    weigh_against_rest,
)
from rs_localizer.core.prior import PriorTerms, held_beside
from rs_localizer.core.ransac import Observations
from rs_localizer.core.refine import step_between
from rs_localizer.core.so3 import Array

# Points whose depth relief is a smaller part than this of their narrower extent are a plane.
_PLANE = 0.1
# What leans by less (rad) has no mirrored pose of its own.
_LEAST_LEAN = 0.01
# A pose that fits worse by this many noise variances is out of the question: odds of 100 to 1.
_CLEARLY_WORSE = 9.2
# The covariance speaks for poses within so many standard deviations of the orientation.
_COVERED = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class _Mode:
    state: Array  # (18,)
    cost: float  # noise variances; motion has to explain more than rest


def mirrored(points: Array, state: Array) -> Array | None:
    """The state (18,) whose view of the plane of the points (n,3) leans the other way.

    None if the points are no plane, or face the camera.
    """
    if len(points) == 0:
        return None
    centre = points.mean(axis=0)
    offsets = points - centre
    extents, axes = np.linalg.eigh(offsets.T @ offsets)
    if not extents[0] < _PLANE**2 * extents[1]:
        return None
    rotation, translation = state[:9].reshape(3, 3), state[9:12]
    seen = rotation @ centre + translation
    sight = seen / np.linalg.norm(seen)
    normal = rotation @ axes[:, 0]
    axis = np.cross(sight, normal * np.sign(sight @ normal))
    lean = math.asin(min(float(np.linalg.norm(axis)), 1.0))
    if lean < _LEAST_LEAN:
        return None
    flip = so3.exp(-2.0 * lean * axis / np.linalg.norm(axis))
    turned = flip @ (translation - seen) + seen
    return np.concatenate([(flip @ rotation).ravel(), turned, state[12:]])


def settle(
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, may_rest: bool
) -> Posterior:
    """The maximum a posteriori motion: of the two before a plane the better one, and nearer to
    rest if the points show no motion.

    Args:
        start: state (18,).
        threshold: px, of inliers.
        may_rest: nothing speaks for a motion but the points.
    """
    posterior = maximum_a_posteriori(observations, start, terms, threshold)
    if not posterior.determined:
        return posterior
    moving = _pair(observations, posterior, posterior.state, terms)
    if moving and moving[1].cost < moving[0].cost:
        posterior = maximum_a_posteriori(observations, moving[1].state, terms, threshold)
    modes, rest = moving, None
    if moving and may_rest:
        still = np.concatenate([posterior.state[:12], np.zeros(6)])
        resting = _pair(observations, posterior, still, held_beside(terms))
        rest = min(resting, key=lambda mode: mode.cost).state if resting else None
        needed = evidence_of_motion(posterior, terms)
        modes = [*(_Mode(m.state, m.cost + needed) for m in moving), *resting]
    if may_rest:
        posterior = weigh_against_rest(observations, posterior, terms, rest)
    return _weigh(posterior, modes) if modes else posterior


def _pair(
    observations: Observations, posterior: Posterior, state: Array, terms: PriorTerms
) -> list[_Mode]:
    """The minimum next to a state and the mirrored one; nothing if there is no such pair."""
    points = observations.points[posterior.inliers]
    if mirrored(points, state) is None:  # mostly: most scenes are no planes
        return []
    first = _mode(observations, posterior, state, terms)
    start = mirrored(points, first.state)
    return [] if start is None else [first, _mode(observations, posterior, start, terms)]


def _mode(
    observations: Observations, posterior: Posterior, start: Array, terms: PriorTerms
) -> _Mode:
    state, _, cost, _ = fit(observations, start, posterior.inliers, terms, posterior.noise)
    return _Mode(state, cost / posterior.noise**2)


def _weigh(posterior: Posterior, modes: list[_Mode]) -> Posterior:
    """The posterior with the covariance that the modes leave possible, and the other pose."""
    # Curved valleys leave the ellipsoid early; the longest axis tells how far they go.
    deviation = math.sqrt(np.linalg.eigvalsh(posterior.covariance[:3, :3])[-1])
    steps = np.array([step_between(posterior.state, mode.state) for mode in modes])
    costs = np.array([mode.cost for mode in modes])
    evidence = costs - costs.min()
    probability = np.exp(-0.5 * evidence)
    probability /= probability.sum()
    # The better of each pair is in the covariance already.
    pairs = costs.reshape(-1, 2)
    probability[(pairs == pairs.min(axis=1, keepdims=True)).ravel()] = 0.0
    covariance = posterior.covariance + np.einsum("k,ki,kj->ij", probability, steps, steps)
    # The farthest of those that are not out of the question.
    turns = np.where(evidence < _CLEARLY_WORSE, np.linalg.norm(steps[:, :3], axis=1), 0.0)
    far = int(np.argmax(turns))
    mirror = Mirror(steps[far], float(evidence[far]), bool(turns[far] < _COVERED * deviation))
    return replace(posterior, covariance=covariance, mirror=mirror)
