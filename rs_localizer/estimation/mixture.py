"""The average of all motions that the inliers of an image leave possible.

The points may hardly tell a slow camera from a resting one, and before a plane motions of very
different speed fit alike, along a curved valley: the typical speed is an unknown of its own. Each
speed, and either way that a plane may lean, is fitted, becomes one Gaussian, and counts by its
probability; what goes out is one Gaussian with the mean and the covariance of them all.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.state import PARAMETERS, at_rest
from rs_localizer.estimation.averaging import alike, averaged, normalized
from rs_localizer.estimation.curvature import along_arcs
from rs_localizer.estimation.doubt import may_face, pieces_of
from rs_localizer.estimation.face_on import reaching
from rs_localizer.estimation.lookalike import holding_motion
from rs_localizer.estimation.mirror import farthest, mirrored
from rs_localizer.estimation.modes import Inliers, Mode
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.prior_terms import PriorTerms, terms_at

# Typical speeds to try, as parts of the configured one; 0 is a camera at rest.
_SPEEDS = (0.0, 0.03, 0.1, 0.3, 1.0)
# Probability of one combination, beside which there is no other.
_ALONE = 0.99
# Logarithm of the odds of a typical speed beside a better one, beyond which none is tried.
_FAR_LESS_PROBABLE = 7.0
# Likewise, beyond which a typical speed hardly counts in the covariance.
_HARDLY_COUNTS = 3.0
# Likewise, beyond which a mirrored pose at rest is not there at any speed.
_OUT_OF_QUESTION = 20.0
# So many noise variances more than another pose, where some of the points fit best, and no fit to
# all of them is needed to rule a pose out.
_HARDLY_THERE = 200.0


def weighed(frame: Inliers, found: Posterior, planar: bool) -> Posterior:
    """The average of all combinations, and the mirrored pose if it cannot be ruled out."""
    modes = _modes(frame, found, planar)
    if planar:
        modes = _in_pieces(frame, modes)
    evidence = np.array([mode.evidence for mode in modes])
    if not np.any(evidence > -math.inf):
        return replace(found, smallest_eigenvalue=0.0)
    at_rest = np.array([mode.speed == 0.0 for mode in modes])
    possible = normalized(np.array([mode.support for mode in modes]))
    counting = normalized(evidence + frame.odds * at_rest)
    best = int(np.argmax(counting))
    state, covariance, steps = averaged(
        np.array([mode.state for mode in modes]),
        np.array([mode.covariance for mode in modes]),
        best, counting, possible,
    )  # fmt: skip
    # A motion that is not known leaves room for the facing pose as it is.
    known = frame.assumed.turn is not None or not frame.assumed.rolling
    faces = may_face(frame, modes, state, covariance) if planar and known else None
    if faces is not None:
        covariance = reaching(covariance, faces.step, faces.evidence)
    if planar and frame.assumed.may_rest:
        covariance = holding_motion(modes, state, covariance)
    costs = np.array([mode.cost for mode in modes])
    same = [alike(modes[best].state, mode.state, modes[best].covariance) for mode in modes]
    if not frame.assumed.may_rest and faces is None and possible @ same > _ALONE:
        # Nothing but what was found, with its shaking.
        covariance = along_arcs(found.covariance, found.state[9:12])
        if frame.unheard is not None:
            covariance[:PARAMETERS, :PARAMETERS] += frame.unheard
        mirror = farthest(costs, evidence, steps, covariance) if planar else None
        return replace(found, covariance=covariance, mirror=mirror)
    # Shaking that was not seen may be there all the same, unless the camera rests.
    moving = max(1.0 - possible @ at_rest, 0.0)
    if frame.unheard is not None:
        covariance += moving * frame.unheard
    joint = moving * found.covariance
    joint[:PARAMETERS, :PARAMETERS] = covariance
    joint[:PARAMETERS, PARAMETERS:] = 0.0
    joint[PARAMETERS:, :PARAMETERS] = 0.0
    return replace(
        found,
        state=state,
        covariance=joint,
        shake=np.zeros_like(found.shake),  # it was that beside another motion
        squared_errors=frame.observations.squared_errors(state),
        model_error=float(possible @ [mode.field for mode in modes]),
        mirror=farthest(costs, evidence, steps, covariance) if planar else None,
        facing=faces,
    )


def _modes(frame: Inliers, found: Posterior, planar: bool) -> list[Mode]:
    """A Gaussian for each speed and, before a plane, for either way that it may lean."""
    may_rest, turn_known = frame.assumed.may_rest, frame.assumed.turn is not None
    modes: list[Mode] = []
    near = at_rest(found.state) if may_rest else found.state
    points = frame.observations.points
    other, one = mirrored(points, frame.inliers, near) if planar else None, False
    for speed in _SPEEDS if may_rest else (1.0,):
        chosen = terms_at(frame.terms, speed, turn_known)
        if speed == 1.0 and frame.only is not None:
            mode = frame.gaussian(frame.only, chosen, speed, near)
        else:
            mode = frame.mode(near, chosen, speed)
        modes.append(mode)
        near = mode.state
        if planar and other is None:
            other = mirrored(points, frame.inliers, near)
        if other is not None:
            twin = mode if one else _twin(frame, mode, other, chosen)
            modes.append(twin)
            other, one = twin.state, twin is mode or _out_of_question(frame, mode, twin)
        if max(mode.evidence for mode in modes if mode.speed == speed) < (
            max(mode.evidence for mode in modes) - _FAR_LESS_PROBABLE
        ):
            break  # what moves faster explains even less
    return modes


def _twin(frame: Inliers, mode: Mode, other: Array, terms: PriorTerms) -> Mode:
    """The Gaussian that a mirrored start (24,) leads to; the mode itself where they meet."""
    nearer, cost = frame.fitted_to_some(other, terms)
    if cost > (mode.cost + _HARDLY_THERE) * frame.noise**2:
        twin = frame.gaussian((nearer, cost), terms, mode.speed, other)
        if -math.inf < twin.evidence < mode.evidence - 2.0 * _OUT_OF_QUESTION:
            return twin
    rough = frame.fitted_roughly(nearer, terms)
    best = mode.state, mode.cost * frame.noise**2
    if frame.leads_to(rough, best, mode.covariance):
        return mode
    twin = frame.gaussian(rough, terms, mode.speed, other)
    if -math.inf < twin.evidence < mode.evidence - _OUT_OF_QUESTION:
        return twin
    fitted = frame.fitted(nearer, terms)
    if alike(mode.state, fitted[0], mode.covariance):
        return mode
    return frame.gaussian(fitted, terms, mode.speed, other)


def _out_of_question(frame: Inliers, mode: Mode, twin: Mode) -> bool:
    """Whether a mirrored pose is so far off that it need not be followed to where it ends.

    At full speed there is none but the best one, and this mode explains the points nearly as well.
    """
    return (
        frame.only is not None
        and mode.cost < frame.only[1] / frame.noise**2 + 2.0 * _OUT_OF_QUESTION
        and twin.cost > mode.cost + 2.0 * _OUT_OF_QUESTION
        and twin.evidence < mode.evidence - _OUT_OF_QUESTION
    )


def _in_pieces(frame: Inliers, modes: list[Mode]) -> list[Mode]:
    """The modes, and in place of those of planes that nearly face the camera pieces of them."""
    supports = {mode.speed: -math.inf for mode in modes}
    for mode in modes:
        supports[mode.speed] = max(supports[mode.speed], mode.support)
    pieces: list[Mode] = []
    for speed, support in supports.items():
        here = [mode for mode in modes if mode.speed == speed]
        counts = support > max(supports.values()) - _HARDLY_COUNTS
        pieces += (pieces_of(frame, here, _FAR_LESS_PROBABLE) if counts else []) or here
    return pieces
