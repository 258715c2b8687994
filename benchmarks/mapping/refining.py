# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps refined with a global shutter, with the rolling one, and with its time found."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.independent.cameras import Camera
from benchmarks.mapping.rooms import (
    Film,
    a_walk,
    estimators_camera,
    walls,
)
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.tools.adjust.system import Factored
from rs_localizer.tools.adjust.variables import Freedom, start_state
from rs_localizer.tools.mapping.gauge import through
from rs_localizer.tools.mapping.observations import MapObservations, RigCamera, Start
from rs_localizer.tools.mapping.refine import (
    MapFreedom,
    Preparation,
    RefinedMap,
    apply_similarity,
    refine,
)

_NOISE, _OFF = 0.3, 0.02  # px, m
_READOUT = 0.03
_UNIT = 1.7  # m


def _errors(points: Array, truth: Array, of: BoolArray) -> str:
    """Of landmarks, but for the whole's place and size."""
    off = through(points[of], truth[of])(points[of]) - truth[of]
    errors = 1e3 * np.linalg.norm(off, axis=1)
    return f"{np.median(errors):8.2f} {np.percentile(errors, 95):8.2f}"


def bend(seed: int) -> Iterator[str]:
    """Errors of one map: as given, and adjusted with each shutter."""
    camera, rng = Camera(), np.random.default_rng(seed)
    walk, points = a_walk(rng, 0.6), walls(rng, 1500)
    film = Film(camera, walk, np.arange(0.0, 12.0, 1.0 / 15.0))
    seen, start = film.see(points, _NOISE, rng, 80), film.near(points, _OFF, rng)
    yield "shutter of the adjustment    landmarks  median    95 % (mm)  noise (px)  readout (ms)"
    first = ""
    for name, readout, free, offset in (
        ("global", 0.0, False, 0.5 * _READOUT),
        ("rolling, given", _READOUT, False, 0.0),
        ("rolling, found from 20 ms", 0.02, True, 0.0),
    ):
        found = refine(
            estimators_camera(camera, readout), seen, start, MapFreedom(readout_time=free),
            stamp_offset=offset,
        )  # fmt: skip
        of = found.refined & (found.sights >= 6)
        if not first:
            first = _errors(start.points, points, of)
            yield f"{'as given':28} {np.count_nonzero(of):9} {first}"
        spread = "" if not free else f" +- {1e3 * found.readout_time_deviation:.3f}"
        yield (
            f"{name:28} {np.count_nonzero(of):9} {_errors(found.points, points, of)} "
            f"{found.after:10.3f}  {1e3 * found.readout_time:.3f}{spread}"
        )


def bound(seed: int, trials: int = 20) -> Iterator[str]:
    """Errors by the Cramer-Rao bound, where ten landmarks are known."""
    camera, rng = Camera(), np.random.default_rng(seed)
    walk, points = a_walk(rng, 0.3, 0.8), walls(rng, 500)
    film = Film(camera, walk, np.arange(0.0, 2.0, 1.0 / 15.0))
    exact = film.see(points, 0.0, rng, 60)
    seen_often = np.argsort(-np.bincount(exact.landmarks, minlength=len(points)))
    deviations = np.full(len(points), np.inf)
    deviations[seen_often[:10]] = 1e-4
    ours = estimators_camera(camera, _READOUT)
    freedom = MapFreedom(deviations=deviations)
    least, ratios, own = None, [], []
    for _ in range(trials):
        noisy = exact.pixels + rng.normal(0.0, _NOISE, exact.pixels.shape)
        start = film.near(points, _OFF, rng)
        known = points + rng.normal(0.0, 1e-4, points.shape)
        places = np.where(np.isfinite(deviations)[:, None], known, start.points)
        seen = replace(exact, pixels=noisy)
        found = refine(ours, seen, replace(start, points=places), freedom)
        if least is None:
            least = _least(seen, found, freedom)
        of = found.refined & np.isinf(deviations) & (found.sights >= 4)
        squared = np.sum((found.points - points) ** 2, axis=1)
        ratios.append(squared[of] / np.trace(least, axis1=1, axis2=2)[of])
        own.append(squared[of] / np.trace(found.covariances, axis1=1, axis2=2)[of])
    yield (
        f"{trials} maps of {np.count_nonzero(of)} landmarks: rms error by the bound "
        f"{np.sqrt(np.mean(np.concatenate(ratios))):.3f}, by the deviations that were told "
        f"{np.sqrt(np.mean(np.concatenate(own))):.3f}"
    )


def _least(seen: MapObservations, found: RefinedMap, freedom: MapFreedom) -> Array:
    """Covariances (p,3,3) of an estimator that loses nothing, at errors of zero."""
    start = Start(found.points, *found.poses())
    prepared = Preparation([RigCamera(found.camera)], seen, start, freedom)
    (observed,) = prepared.observations()
    free = Freedom(
        readout_time=False, angular_acceleration=freedom.angular_acceleration,
        linear_acceleration=freedom.linear_acceleration,
    )  # fmt: skip
    state = start_state(found.camera, observed, found.spline, found.readout_time)
    problem = prepared.problem([observed], state, free)
    (sights,) = problem.sights(state)
    fitting = replace(observed, pixels=observed.pixels + sights.errors)
    problem = prepared.problem([fitting], state, free)
    factored = Factored(problem.system(state, _NOISE))
    every = np.ones(len(found.points), np.bool_)
    return apply_similarity(problem, state, factored, every).covariances


def large(seed: int) -> Iterator[str]:
    """300 images that stand alone, 20,000 landmarks."""
    camera, rng = Camera(), np.random.default_rng(seed)
    walk, points = a_walk(rng, 0.25), walls(rng, 20_000)
    film = Film(camera, walk, np.arange(0.0, 119.9, 0.4))
    seen, start = film.see(points, _NOISE, rng), film.near(points, _OFF, rng)
    wall, busy = time.perf_counter(), time.process_time()
    found = refine(estimators_camera(camera, _READOUT), seen, start)
    wall, busy = time.perf_counter() - wall, time.process_time() - busy
    yield (
        f"300 images, {np.count_nonzero(found.refined)} landmarks, {len(seen.images)} keypoints: "
        f"{wall:.0f} s, {busy:.0f} s of CPU; median and 95 % of the errors (mm) before "
        f"{_errors(start.points, points, found.refined)}, after "
        f"{_errors(found.points, points, found.refined)}"
    )


def regions(seed: int, walks: int = 8) -> Iterator[str]:
    """Landmarks of walks, in units of their own, by the deviations that are told of them."""
    every = []
    for k in range(walks):
        camera, rng = Camera(), np.random.default_rng([seed, k])
        walk, points = a_walk(rng, 0.5), walls(rng, 1500)
        film = Film(camera, walk, np.arange(0.0, 12.0, 1.0 / 15.0))
        start = film.near(points, _OFF, rng)
        start = replace(start, points=start.points / _UNIT, positions=start.positions / _UNIT)
        seen = film.see(points, _NOISE, rng, 80)
        found = refine(estimators_camera(camera, _READOUT), seen, start)
        own, true = found.points[found.refined], points[found.refined]
        variances = np.einsum("nii->ni", found.covariances[found.refined])
        every.append(np.abs(own - through(true, own)(true)) / np.sqrt(variances))
        inside = (100.0 * np.mean(every[-1] < q) for q in (1.0, 1.96, 3.0))
        yield "walk {}: inside 68, 95, 99.7 %: {:.1f}, {:.1f}, {:.1f}".format(k, *inside)
    inside = (100.0 * np.mean(np.concatenate(every) < q) for q in (1.0, 1.96, 3.0))
    yield "coordinates of landmarks inside 68, 95, 99.7 %: {:.1f}, {:.1f}, {:.1f}".format(*inside)
