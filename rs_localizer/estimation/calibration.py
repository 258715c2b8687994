# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Effect of errors of calibration and map, the same in all frames, on a pose.

Principal point, focal lengths and distortion of an ordinary calibration have errors. A bent map
has some too, or whatever else a smooth error was fitted for. Landmarks that were found together
have common errors, which the map may state (:class:`ErrorModes`). No tracker averages these errors
away: they are added to the published estimate of a frame, and not to what the next frame is given.

``A`` are the derivatives of the pixels by motion and smooth error, and ``H = A^T A + noise^2 P`` is
the information of points and prior. To first order a calibration that moves the pixels by ``b``
moves motion and smooth error by ``-H^-1 A^T b``. A smooth error of ``f`` deviations moves them by
``-noise^2 H^-1 f``.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from rs_localizer.config import CalibrationErrors
from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.bearings import pinhole, projected_by
from rs_localizer.core.blocks import write
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import by_lens, coefficients_of, corner_of
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import MOTION_PARAMETERS, MOVE, PARAMETERS, POSE, TURN, rotation_of
from rs_localizer.estimation.hypotheses import Posterior
from rs_localizer.estimation.linear_fit import ORDINARY, known_at, smooth_columns_of
from rs_localizer.estimation.moved_part import MovedPart
from rs_localizer.estimation.points import Observed
from rs_localizer.estimation.prior import SPEEDS, PriorTerms, terms_at
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.robust import eliminate, inverted
from rs_localizer.native import entry

# Of each camera: centre (2), focal length, distortion, fy over fx.
_ERRORS = 5
# Of a combination of typical speeds, the part of one that does not count.
_NO_PART = 0.02
_CONFIGURED = np.array([speed == 1.0 for speed in SPEEDS], float)
# fy over fx changes as each changes by a half, the other way.
ASPECT = np.array([-0.5, 0.5])

# More points than this only take time: sums over all of them are as well known.
MANY = 250
# Points this near (m) to a landmark are that landmark, in single precision as far as 8 km.
_SAME = 0.001
# A direction to sort landmarks by: no wall, floor or row of them is across it.
_ASKEW = np.array([0.6180, 0.5698, 0.5417])
_ASKEW /= np.linalg.norm(_ASKEW)


class LandmarkErrors(Protocol):
    """Independent errors that landmarks share."""

    def at(self, points: Array) -> Array:
        """Return by how much one deviation of each moves points (n,3): (n,3,k)."""


class ErrorModes:
    """Independent errors that the landmarks of a map share, by the landmarks' places.

    Args:
        points: (n,3) m, of the landmarks.
        modes: (n,3,k) m, by how much one standard deviation of each error moves them.
    """

    def __init__(self, points: Array, modes: np.ndarray) -> None:
        along = points @ _ASKEW
        self._order = np.argsort(along, kind="stable")
        self._along, self._points = along[self._order], points[self._order]
        self._modes = np.concatenate([modes, np.zeros((1, *modes.shape[1:]), modes.dtype)])

    def at(self, points: Array) -> Array:
        """Return modes (m,3,k) of points (m,3); zeros for points that are no landmarks."""
        # Along any direction, the same landmark is as near or nearer.
        along = points @ _ASKEW
        first = np.searchsorted(self._along, along - _SAME)
        last = np.searchsorted(self._along, along + _SAME, side="right")
        rows = np.full(len(points), len(self._order))  # there is none
        nearest = np.full(len(points), _SAME**2)
        for step in range((last - first).max(initial=0)):
            (these,) = np.nonzero(first + step < last)
            place = first[these] + step
            squared = np.sum((points[these] - self._points[place]) ** 2, axis=1)
            nearer = squared < nearest[these]
            these, place = these[nearer], place[nearer]
            nearest[these], rows[these] = squared[nearer], self._order[place]
        modes: Array = self._modes[rows].astype(np.float64)
        return modes


class CalibrationEffect(NamedTuple):
    """Effect of the errors of calibration and map, one standard deviation of each, on a frame."""

    covariance: Array  # (12,12) of pose and velocities
    residual: float  # px, root mean square of what no motion takes up; a smooth error may
    # rad, of the orientation about the axis known worst, if the camera's motion were known
    still_deviation: float


NO_EFFECT = CalibrationEffect(np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS)), 0.0, np.inf)


def calibration_effect(
    observed: Observed, posterior: Posterior, terms: PriorTerms, deviation: CalibrationErrors,
    tracked: bool, moved: MovedPart | None = None,
) -> CalibrationEffect:  # fmt: skip
    """Return the effect of errors of calibration and map on the motion of a frame.

    Args:
        terms: what is known of the motion but for poses of other frames, which are off by as much.
        tracked: poses of other frames are known, so that the covariance has no longer all of what
            the smooth error does.
        moved: part of the map that is elsewhere; what it leaves of the points nobody has declared.
    """
    observations, chosen = observed.observations, np.flatnonzero(posterior.inliers)
    exposure, found = observed.exposure, len(chosen)
    if found > MANY:
        chosen = chosen[np.linspace(0, found - 1, MANY).astype(np.int64)]
    some = observations.only(chosen)
    state, tau = posterior.state, some.tau
    lines = linearized(some.packed, len(some), state, shake_at(tau, posterior.shake))
    by_motion, image = lines.by_motion, lines.image
    rotation, rays = observed.rotation, image
    if rotation is not None:  # which was taken out
        turned = rotation.at_rows(tau)[0]
        local = np.einsum("nij,nj->ni", turned, np.column_stack([image, np.ones(len(image))]))
        rays = local[:, :2] / local[:, 2:]
    of_side = some.camera
    columns = np.zeros((len(rays), 2, _ERRORS * len(exposure.cameras)))
    for place, side in enumerate(exposure.sides):
        here, first = of_side == place, _ERRORS * side.place
        if np.any(here):
            columns[here, :, first : first + _ERRORS] = _columns(
                side.camera, side.towards(rays[here]), deviation
            )
    declared = columns.shape[2]
    of_map = observed.error_modes
    if of_map is not None or moved is not None:
        places = observed.points[observed.usable.indices[chosen]]
        modes = [each.at(places) for each in (of_map, moved) if each is not None]
        declared += modes[0].shape[2] if of_map is not None else 0
        # A camera that moves as the point does would move it the other way: of a deviation either
        # sign will do.
        by_point = by_motion[:, :, MOVE] @ rotation_of(state)
        columns = np.concatenate([columns, by_point @ np.concatenate(modes, axis=2)], axis=2)
    bend = posterior.bend[chosen] if posterior.bend.shape[1] else np.zeros((len(rays), 0))
    of_speeds = posterior.speeds if len(posterior.speeds) else _CONFIGURED
    lens = some.lens_of(exposure.lenses)
    smooth = smooth_columns_of(by_motion, image, bend, lens)
    # Without other frames the covariance has all of what the smooth error does.
    covariance, left, still = _effect(
        smooth, by_motion, columns, (posterior.shared, found / len(rays), tracked), of_speeds,
        terms, state, posterior.noise**2, rotation is not None,
    )  # fmt: skip
    still *= math.sqrt(posterior.inflation)
    if not (np.isfinite(covariance).all() and np.isfinite(left).all()):
        return NO_EFFECT._replace(still_deviation=still)
    residual = math.sqrt(max(float(left[:declared].sum()), 0.0) / (2.0 * found))
    return CalibrationEffect(covariance, residual, still)


@entry
def _effect(
    by_smooth: Array3, by_motion: Array3, by_errors: Array3, given: tuple[float, float, bool],
    of_speeds: Array1, terms: PriorTerms, state: Array1, variance: float, turn_known: bool,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Return what errors of one deviation do to pose and velocities, and what they leave.

    Args:
        by_smooth, by_motion, by_errors: (n,2,q), (n,2,18), (n,2,k) px.
        given: size of the smooth error (px); weight of products, for points that are left out; and
            whether the smooth error does something beside the covariance, too.
        of_speeds: probabilities of typical speeds.

    Returns:
        covariance (12,12) and what no motion takes up (k,), px^2, NaN: nothing is determined; and
        the deviation (rad) of the orientation about the axis known worst if the motion were known.
    """
    (shared, weight, is_beside), smooth, still = given, by_smooth.shape[2], np.inf
    last = smooth + PARAMETERS
    size = last + by_errors.shape[2]
    rows = np.empty((len(by_motion), 2, size))
    for i in range(len(rows)):
        for side in range(2):
            row = rows[i, side]
            for k in range(smooth):
                row[k] = shared * by_smooth[i, side, k]
            write(row[smooth:last], by_motion[i, side])
            write(row[last:], by_errors[i, side])
    flat = rows.reshape(-1, size)
    every = weight * (flat.T @ flat)
    of_pose = inverted(every[smooth : smooth + POSE.stop, smooth : smooth + POSE.stop].copy())
    if np.isfinite(of_pose[0, 0]):
        still = math.sqrt(variance) * longest_axis(of_pose[TURN, TURN].copy())
    columns = size + smooth if is_beside else size
    whole = np.zeros((columns, columns))
    whole[:size, :size] = every
    for k in range(smooth):
        whole[k, k] += variance
        if is_beside:
            whole[k, size + k] = variance
    eliminate(whole, smooth)  # for all speeds
    beside, alone = np.zeros((PARAMETERS, PARAMETERS)), np.zeros((PARAMETERS, PARAMETERS))
    for k in range(len(of_speeds)):
        if of_speeds[k] > _NO_PART:
            known = known_at(terms_at(terms, SPEEDS[k], turn_known), state)
            prior = variance * known.form[:PARAMETERS, :PARAMETERS]
            beside += of_speeds[k] * inverted(whole[smooth:last, smooth:last] + prior)
            alone += of_speeds[k] * inverted(every[smooth:last, smooth:last] + prior)
    pull = beside[:MOTION_PARAMETERS] @ whole[smooth:last, last:].copy()
    of_motion, of_errors = every[smooth:last, smooth:last].copy(), every[smooth:last, last:].copy()
    taken = alone @ of_errors
    left = np.sum(taken * (of_motion @ taken - 2.0 * of_errors), axis=0)
    return pull @ pull.T, left + np.diag(every)[last:], still


def promised(posterior: Posterior) -> float:
    """Smooth errors (px, root mean square) that map and calibration are declared to leave."""
    return math.hypot(posterior.declared, ORDINARY)


def widened(effect: CalibrationEffect, posterior: Posterior) -> CalibrationEffect:
    """Return the effect of a calibration and a map whose errors exceed the declared ones.

    To a factor of e their size is not known (:mod:`.linear_fit`). What lies beyond is an error
    of the deviations, all of them alike (Birge's ratio): residuals do not tell which.
    """
    ratio = posterior.model_error / (math.e * promised(posterior))
    return effect._replace(covariance=max(ratio, 1.0) ** 2 * effect.covariance)


def _columns(camera: Camera, towards: Array, deviation: CalibrationErrors) -> Array:
    """Return shifts (n,2,5) px of rays or bearings by a standard deviation of each error."""
    corner = corner_of(camera)
    corner_pixels = corner * camera.focal_length / camera.binning[0]
    lens = pinhole(camera)
    if lens is not None:  # the same, for less
        by_k1 = deviation.distortion / (corner_pixels * corner**2)
        sizes = deviation.principal_point, deviation.focal_length, by_k1, deviation.aspect_ratio
        columns: Array = _by_pinhole(towards, lens[0], lens[2], np.array(sizes))
        return columns
    columns = np.zeros((len(towards), 2, _ERRORS))
    columns[:, 0, 0] = columns[:, 1, 1] = deviation.principal_point
    by_all = by_lens(camera, towards)
    focal = coefficients_of(camera) - 4
    columns[:, :, 2] = deviation.focal_length * by_all[:, :, focal : focal + 2].sum(axis=2)
    columns[:, :, 3] = deviation.distortion / corner_pixels * by_all[:, :, 0]
    by_each = np.diagonal(by_all[:, :, focal : focal + 2], axis1=1, axis2=2)
    columns[:, :, 4] = deviation.aspect_ratio * by_each * ASPECT
    return columns


@entry
def _by_pinhole(rays: Array2, focal: Array1, lens: Array1, sizes: Array1) -> Array:
    """Return shifts as :func:`_columns` through a lens of :func:`pinhole`, by errors (4,)."""
    columns = np.zeros((len(rays), 2, _ERRORS))
    pixels, _ = projected_by(rays, focal, np.zeros(2), lens)
    for i in range(len(rays)):
        square = np.sum(rays[i] ** 2)
        slope = square / (1.0 + square * (lens[5] + square * (lens[6] + square * lens[7])))
        for axis in range(2):
            columns[i, axis, axis] = sizes[0]
            columns[i, axis, 2] = sizes[1] * pixels[i, axis]
            columns[i, axis, 3] = sizes[2] * focal[axis] * rays[i, axis] * slope
            columns[i, axis, 4] = sizes[3] * pixels[i, axis] * ASPECT[axis]
    return columns


@entry
def longest_axis(covariance: Array2) -> float:
    """Return the deviation (rad) of the rotation (3,3) about the axis that is known worst."""
    return math.sqrt(max(np.linalg.eigh(covariance)[0][-1], 0.0))
