# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map refined with the shutter that its images show, where nobody knows it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.tools.adjust.problem import noise_of
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.mapping.map_keypoints import MapFreedom, MapObservations, Start
from rs_localizer.tools.mapping.refinement import RefinedMap, refine
from rs_localizer.tools.readout_belief import ReadoutCheck, ShutterFit

LEAST_FIT = 0.8
"""Share of the keypoints that fit a good map: nine in ten do."""


def likely_axis(size: tuple[int, int], given: str | None) -> ScanDirection:
    """Return a given scan direction, or the likely one, reversed if the readout time is negative.

    The rows of sensors lie along their longer side, also where a driver or a phone has turned the
    images.
    """
    if given is not None:
        return ScanDirection(given)
    return ScanDirection.TOP_TO_BOTTOM if size[0] >= size[1] else ScanDirection.LEFT_TO_RIGHT


# Standard deviations of COLMAP's lens: focal length and centre over the focal length (of one
# phone's video 21 images give 384.2 px, 42 give 383.2), and distortion. Under a steady motion a
# focal length along the scan resembles a shutter; looser priors leave the choice to chance.
_LENS_DEVIATIONS = 0.005, 0.02


def colmap_freedom(lens: bool) -> MapFreedom:
    """Return the unknowns of a map that COLMAP has begun; ``lens``: its lens, too."""
    return MapFreedom(lens=lens, lens_deviations=_LENS_DEVIATIONS)


def fit_shutter(
    camera: Camera,
    observations: MapObservations,
    start: Start,
    freedom: MapFreedom,
    done: Callable[[str], object],
) -> tuple[RefinedMap, ShutterFit | None]:
    """Refine the map with the shutter that explains the images best.

    A shutter is only believed if it explains them significantly better than a global one. If no
    smooth motion fits them as well as the first guess (a time lapse, cuts), each image keeps its
    own pose, as in COLMAP, and the shutter stays unknown.

    Args:
        camera: its lens, and the axis of its scan.
        observations, start, freedom: as of :func:`refine`.
        done: called with each part of the work that is done.

    Returns:
        the map, and what the shutter was found to be; None: too few images follow each other, or
        they are ``apart``.

    Raises:
        ValueError: as :func:`refine`.
    """
    camera, smooth = replace(camera, readout_time=0.0), None
    with suppress(ValueError):  # what is wrong with the images is raised below
        smooth = _of_one_motion(camera, observations, start, freedom, done)
        best = smooth[0]
        if best.fit_share >= LEAST_FIT and best.after <= _noise(camera, observations, start):
            return smooth
    try:
        apart = refine(camera, observations, start, replace(freedom, apart=True))
    except ValueError:
        if smooth is None:
            raise
        return smooth
    return smooth if smooth and apart.fit_share < LEAST_FIT else (apart, None)


def refine_with_shutter(
    camera: Camera, observations: MapObservations, start: Start, freedom: MapFreedom,
    given: float | None, done: Callable[[str], object],
) -> tuple[RefinedMap, ShutterFit | None, ReadoutCheck | None]:  # fmt: skip
    """Refine the map with a given readout time (s), and check it.

    Else, or where the images contradict it, as of :func:`fit_shutter`: a map that was adjusted with
    the wrong one is bent to it, and fits it nearly as well.
    """
    check = None
    if given is not None:
        known = replace(camera, readout_time=given)
        refined = refine(known, observations, start, freedom, done=done)
        check = refined.readout_check
        if check is None or not check.differs:
            return refined, None, check
    return *fit_shutter(camera, observations, start, freedom, done), check


def global_errors(camera: Camera, observations: MapObservations, start: Start) -> Array:
    """Return distances (n,), px, of keypoints from their global-shutter projections."""
    found = camera.project(start.local(observations)) - observations.pixels
    return np.asarray(np.linalg.norm(found, axis=1))


def _noise(camera: Camera, observations: MapObservations, start: Start) -> float:
    """Return the standard deviation (px) of the residuals of the first guess."""
    errors = global_errors(camera, observations, start)
    return noise_of(errors[np.isfinite(errors)] ** 2, np.inf)


def _of_one_motion(
    camera: Camera, observations: MapObservations, start: Start, freedom: MapFreedom,
    done: Callable[[str], object],
) -> tuple[RefinedMap, ShutterFit | None]:  # fmt: skip
    """Refine by one smooth motion through successive images; see :func:`fit_shutter`."""
    from scipy.stats import wilcoxon  # takes a second

    still = refine(camera, observations, start, freedom, done=done)
    if not still.tells_readout:
        return still, None
    free = replace(freedom, readout_time=True)
    rolling = refine(still.camera, observations, start, free, done=done)
    gains = _costs(still, still, observations) - _costs(rolling, still, observations)
    shutter = ShutterFit(
        readout_time=rolling.camera_as_found.readout_time,
        deviation=rolling.readout_time_deviation,
        direction=ScanDirection(rolling.camera_as_found.scan_direction),
        noise=rolling.after,
        global_noise=still.after,
        better_images=float(np.mean(gains > 0.0)),
        # Images at rest gain nothing, those of a quick turn much: the signed-rank test.
        chance=float(wilcoxon(gains, alternative="greater").pvalue),
        interval=1e-9 * float(np.median(np.diff(observations.stamps_ns))),
    )
    return (rolling if shutter.visible else still), shutter


def _costs(fit: RefinedMap, still: RefinedMap, observations: MapObservations) -> Array:
    """Return squared errors of the images (g,), outliers cut off alike in all fits."""
    limit = (LIMIT * still.deviation) ** 2
    squared = np.minimum(np.where(np.isfinite(fit.squared_errors), fit.squared_errors, 0.0), limit)
    sums = np.bincount(observations.images, squared, len(observations.stamps_ns))
    return np.asarray(sums, np.float64)
