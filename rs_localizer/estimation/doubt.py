"""Planes whose lean is in doubt: its posterior in pieces, and whether they may face the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.state import TURN, step_between
from rs_localizer.estimation.face_on import (
    DENIED,
    NEARBY,
    OVERLAP,
    RULED_OUT,
    held_facing,
    squared_deviations,
    windows,
)
from rs_localizer.estimation.modes import Inliers, Mode
from rs_localizer.estimation.posterior import Mirror
from rs_localizer.estimation.prior_terms import terms_at


def may_face(frame: Inliers, modes: list[Mode], state: Array, covariance: Array) -> Mirror | None:
    """The pose of a plane that faces the camera, from a state, unless it is ruled out."""
    window = held_facing(frame.observations.points, frame.inliers, state, covariance)
    if window is None:
        return None
    most, found = max(mode.evidence for mode in modes), None
    near = float(np.linalg.norm(step_between(state, window.state)[TURN])) < NEARBY
    fastest = {mode.speed: mode for mode in sorted(modes, key=lambda mode: mode.evidence)}
    for mode in fastest.values():
        unlikely = 2.0 * (most - mode.evidence)
        if unlikely < RULED_OUT:
            terms = terms_at(frame.terms, mode.speed, frame.assumed.turn is not None)
            there, cost = frame.fitted(window.state, window.times(terms))
            worse = max(cost / frame.noise**2 - mode.cost, 1.0)
            apart = squared_deviations(mode.covariance, step_between(mode.state, there))
            denied = apart > DENIED * worse
            if denied and unlikely + worse < (found.evidence if found else RULED_OUT):
                found = Mirror(step_between(state, there), unlikely + worse, covered=near)
    return found


def pieces_of(frame: Inliers, modes: list[Mode], least: float) -> list[Mode]:
    """Pieces of a speed's Gaussians along the lean, while their evidence is within ``least``."""
    best = min(modes, key=lambda mode: mode.cost)
    pieces: list[Mode] = []
    points = frame.observations.points
    for window in windows(points, frame.inliers, best.state, best.covariance):
        terms = terms_at(frame.terms, best.speed, frame.assumed.turn is not None)
        within = window.times(terms)
        fitted = frame.fitted(window.state, within)
        piece = frame.gaussian(fitted, within, best.speed, window.state)
        pieces.append(replace(piece, evidence=piece.evidence - OVERLAP))
        if piece.evidence < max(one.evidence for one in pieces) - least:
            break
    return pieces
