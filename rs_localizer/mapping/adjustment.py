# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Map and motion together: the cost, its normal equations, their solution, and what is known then.

Landmarks are eliminated (Schur complement): with their 3x3 blocks V, the derivatives W of controls
and shared numbers by landmarks and the rest H, the reduced system is ``H - W V^-1 W^T`` (Triggs et
al., *Bundle adjustment: a modern synthesis*, 1999, section 6). Of a keypoint only its whitened row
is kept: 24 controls, shared numbers, 3 of its landmark and the error. The reduced system is dense:
a landmark that is seen at distant times ties all controls of these times together. It is factored
as a whole (LAPACK): 300 images on their own have 7200 unknowns, which is a few seconds and 0.4 GB.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.blas import dtrmv
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse import diags
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.mapping.gauge import Floating, as_held, generators, laid_over
from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.model import Observations, State
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.problem import RigNormal, RigProblem
from rs_localizer.trajectory.sight_kernels import Curve, Sights, Terms, differentiate, make_row
from rs_localizer.trajectory.spline import Spline
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL, ORDER


class Rows(NamedTuple):
    """Whitened derivatives of all keypoints, and the landmarks that they show."""

    values: Array  # (n,2,24 + s + 3 + 1): controls, shared numbers, landmark, error
    first: IntArray  # (n,) first of the four controls
    order: IntArray  # (n,) keypoints by landmark, those of each by ``first``
    starts: IntArray  # (p + 1,) where each landmark begins in ``order``
    precisions: Array  # (p,) 1/m^2, of what is known of the landmarks beforehand
    offsets: Array  # (p,3) m, how far they are from that
    controls: int
    damping: float  # the diagonal of V is multiplied by 1 + this


class Scratch(NamedTuple):
    """What is computed of one landmark after the other."""

    place: IntArray  # (controls,) of a control among those that see the landmark; -1: does not
    touched: IntArray  # (controls,) these, rising
    # (3, controls + 1) runs of columns of the reduced system that the landmark touches: where in
    # ``coupled`` a run begins and where the next one does, and its first column.
    runs: IntArray
    coupled: Array  # (3, 6 controls + s) W^T at these columns
    inverse: Array  # (3,3) V^-1
    slope: Array  # (3,)


@kernel
def make_scratch(rows: Rows) -> Scratch:
    """Room for one landmark."""
    most = CONTROL * rows.controls + rows.values.shape[2] - LOCAL - 4
    return Scratch(
        np.full(rows.controls, -1), np.empty(rows.controls, np.int64),
        np.empty((3, rows.controls + 1), np.int64), np.zeros((3, most)), np.empty((3, 3)),
        np.empty(3),
    )  # fmt: skip


@kernel
def record(curve: Curve, terms: Terms, sights: Sights, values: Array) -> None:
    """Fill the whitened rows of keypoints; zeros for those that do not count."""
    row = make_row(sights, terms)
    shared = row.by_shared.shape[1]
    for n in range(len(sights.first)):
        weight, _ = differentiate(curve, sights, terms, n, row)
        scale = np.sqrt(weight)
        if weight == 0.0:
            values[n] = 0.0
            continue
        for r in range(2):
            out = values[n, r]
            for k in range(LOCAL):
                out[k] = scale * row.by_controls[r, k]
            for k in range(shared):
                out[LOCAL + k] = scale * row.by_shared[r, k]
            for k in range(3):
                out[LOCAL + shared + k] = scale * row.by_landmark[r, k]
            out[LOCAL + shared + 3] = scale * row.error[r]


@inlined
def _invert(a: Array, out: Array) -> None:
    """Inverse of a symmetric positive (3,3) matrix."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    share = 1.0 / (a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02)
    out[0, 0] = share * c00
    out[0, 1] = out[1, 0] = share * c01
    out[0, 2] = out[2, 0] = share * c02
    out[1, 1] = share * (a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2])
    out[1, 2] = out[2, 1] = share * (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2])
    out[2, 2] = share * (a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1])


@kernel
def gather(rows: Rows, landmark: int, scratch: Scratch) -> int:
    """Fill the blocks of one landmark; returns the number of runs of columns that it touches."""
    shared = rows.values.shape[2] - LOCAL - 4
    own, information, slope = LOCAL + shared, np.zeros((3, 3)), scratch.slope
    count, runs = _touch(rows, landmark, scratch, shared)
    end = CONTROL * count
    for i in range(3):
        information[i, i] = rows.precisions[landmark]
        slope[i] = rows.precisions[landmark] * rows.offsets[landmark, i]
    for k in range(rows.starts[landmark], rows.starts[landmark + 1]):
        n = rows.order[k]
        base = CONTROL * scratch.place[rows.first[n]]
        for r in range(2):
            row = rows.values[n, r]
            for i in range(3):
                x, coupled = row[own + i], scratch.coupled[i]
                slope[i] += x * row[own + 3]
                for j in range(i, 3):
                    information[i, j] += x * row[own + j]
                for a in range(LOCAL):  # the four controls follow each other
                    coupled[base + a] += x * row[a]
                for a in range(shared):
                    coupled[end + a] += x * row[LOCAL + a]
    for i in range(3):
        information[i, i] *= 1.0 + rows.damping
    _invert(information, scratch.inverse)
    for k in range(count):
        scratch.place[scratch.touched[k]] = -1
    return runs


@inlined
def _touch(rows: Rows, landmark: int, scratch: Scratch, shared: int) -> tuple[int, int]:
    """List the controls that see a landmark, and clear what couples it with them.

    Returns their number, and that of their runs and of the shared numbers' one.
    """
    count = runs = 0
    starts, ends, columns = scratch.runs
    for k in range(rows.starts[landmark], rows.starts[landmark + 1]):
        first = rows.first[rows.order[k]]
        for c in range(first, first + ORDER):
            if scratch.place[c] >= 0:
                continue
            if count == 0 or scratch.touched[count - 1] != c - 1:
                starts[runs], columns[runs] = CONTROL * count, CONTROL * c
                runs += 1
            scratch.place[c] = count
            scratch.touched[count] = c
            count += 1
            ends[runs - 1] = CONTROL * count
    if count and shared:
        starts[runs], ends[runs] = CONTROL * count, CONTROL * count + shared
        columns[runs] = CONTROL * rows.controls
        runs += 1
    scratch.coupled[:, : CONTROL * count + shared] = 0.0
    return count, runs


@kernel
def eliminate(rows: Rows, sequence: IntArray, part: int, parts: int, system: Array) -> None:
    """Take landmarks out of a lower triangle (N,N): every ``parts``-th control's rows.

    Args:
        sequence: (p,) the landmarks, those that the same images see behind each other: what they
            touch of a large system is then still at hand.
    """
    scratch = make_scratch(rows)
    inverse, coupled = scratch.inverse, scratch.coupled
    starts, ends, columns = scratch.runs
    for landmark in sequence:
        runs = gather(rows, landmark, scratch)
        for mine in range(runs):
            for a in range(starts[mine], ends[mine]):
                to = columns[mine] + a - starts[mine]
                if (to // CONTROL) % parts != part:
                    continue
                x = y = z = 0.0
                for i in range(3):
                    x += coupled[i, a] * inverse[i, 0]
                    y += coupled[i, a] * inverse[i, 1]
                    z += coupled[i, a] * inverse[i, 2]
                for other in range(mine + 1):
                    start, end = starts[other], min(ends[other], a + 1)
                    row = system[to, columns[other] : columns[other] + end - start]
                    u, v, w = coupled[0, start:end], coupled[1, start:end], coupled[2, start:end]
                    for b in range(end - start):
                        row[b] -= x * u[b] + y * v[b] + z * w[b]


@kernel
def lift(rows: Rows, right: Array, out: Array) -> None:
    """Add ``W V^-1 r`` of right sides (p,3,m) to (N,m)."""
    scratch = make_scratch(rows)
    starts, ends, columns = scratch.runs
    share = np.empty(3)
    for landmark in range(len(rows.starts) - 1):
        runs, r = gather(rows, landmark, scratch), right[landmark]
        for m in range(r.shape[1]):
            for i in range(3):
                share[i] = 0.0
                for j in range(3):
                    share[i] += scratch.inverse[i, j] * r[j, m]
            for run in range(runs):
                for a in range(starts[run], ends[run]):
                    to = columns[run] + a - starts[run]
                    for i in range(3):
                        out[to, m] += scratch.coupled[i, a] * share[i]


@kernel
def lower(rows: Rows, reduced: Array, right: Array) -> None:
    """Turn right sides (p,3,m) into ``V^-1 (r - W^T x)``; ``x`` (N,m) solves the reduced system."""
    scratch = make_scratch(rows)
    starts, ends, columns = scratch.runs
    left = np.empty(3)
    for landmark in range(len(rows.starts) - 1):
        runs, r = gather(rows, landmark, scratch), right[landmark]
        for m in range(r.shape[1]):
            for i in range(3):
                left[i] = r[i, m]
            for run in range(runs):
                for a in range(starts[run], ends[run]):
                    x = reduced[columns[run] + a - starts[run], m]
                    for i in range(3):
                        left[i] -= scratch.coupled[i, a] * x
            for i in range(3):
                r[i, m] = 0.0
                for j in range(3):
                    r[i, m] += scratch.inverse[i, j] * left[j]


@kernel
def slopes(rows: Rows, out: Array) -> None:
    """Derivatives (p,3) of half the cost by the landmarks."""
    scratch = make_scratch(rows)
    for landmark in range(len(rows.starts) - 1):
        gather(rows, landmark, scratch)
        out[landmark] = scratch.slope


@inlined
def _within(scratch: Scratch, runs: int, inverse: Array, out: Array) -> None:
    """``W^T S^-1 W`` (3,3), by the lower triangle of ``S^-1``."""
    coupled = scratch.coupled
    starts, ends, columns = scratch.runs
    half = np.zeros((3, 3))
    for mine in range(runs):
        for a in range(starts[mine], ends[mine]):
            x = y = z = 0.0
            line = inverse[columns[mine] + a - starts[mine]]
            for other in range(mine + 1):
                start, end = starts[other], min(ends[other], a + 1)
                row = line[columns[other] : columns[other] + end - start]
                u, v, w = coupled[0, start:end], coupled[1, start:end], coupled[2, start:end]
                for b in range(end - start):
                    x += row[b] * u[b]
                    y += row[b] * v[b]
                    z += row[b] * w[b]
            own = 0.5 * line[columns[mine] + a - starts[mine]]
            for i in range(3):
                half[i, 0] += coupled[i, a] * (x - own * coupled[0, a])
                half[i, 1] += coupled[i, a] * (y - own * coupled[1, a])
                half[i, 2] += coupled[i, a] * (z - own * coupled[2, a])
    for i in range(3):
        for j in range(3):
            out[i, j] = half[i, j] + half[j, i]


@kernel
def covariances(rows: Rows, sequence: IntArray, inverse: Array, out: Array) -> None:
    """Fill the covariances (p,3,3) of some landmarks, ``V^-1 + V^-1 W^T S^-1 W V^-1``.

    From the lower triangle of ``S^-1`` (N,N); ``sequence`` as for :func:`eliminate`.
    """
    scratch = make_scratch(rows)
    middle, own = np.empty((3, 3)), scratch.inverse
    for landmark in sequence:
        runs = gather(rows, landmark, scratch)
        _within(scratch, runs, inverse, middle)
        for i in range(3):
            for j in range(3):
                total = own[i, j]
                for k in range(3):
                    for m in range(3):
                        total += own[i, k] * middle[k, m] * own[m, j]
                out[landmark, i, j] = total


_WORKERS = 2
# Of the eigenvalue of a mode: a hundredth of what it makes of a deviation.
_MODE_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class MapNormal:
    """Normal equations of motion, shared numbers and landmarks."""

    motion: RigNormal  # with the map as it is
    rows: Rows
    held: Array  # (N,7) whitened directions in which the whole would float
    held_error: Array  # (7,)


class Reduced:
    """A factored system.

    Args:
        normal: the normal equations.
        damping: the diagonal is multiplied by 1 + this (Levenberg and Marquardt).

    Raises:
        Undetermined: when the system is not positive definite.
    """

    def __init__(self, normal: MapNormal, damping: float = 0.0) -> None:
        self._rows = normal.rows._replace(damping=damping)
        motion = normal.motion.whole
        self._controls = len(motion.slope)
        self._slope = np.concatenate([motion.slope, motion.border_slope])
        self._slope += normal.held @ normal.held_error
        system, sequence = _dense(motion, damping), _sequence(self._rows)
        with ThreadPoolExecutor(_WORKERS) as workers:
            list(
                workers.map(
                    lambda part: eliminate(self._rows, sequence, part, _WORKERS, system),
                    range(_WORKERS),
                )
            )
        system += normal.held @ normal.held.T
        # LAPACK counts along columns: the lower triangle is its upper one.
        self._factor, failed = dpotrf(system.T, lower=0, overwrite_a=1, clean=0)
        if failed:
            raise Undetermined("the images do not determine map and motion")

    @property
    def size(self) -> int:
        """Number N of controls' and shared numbers."""
        return len(self._slope)

    def solve(self, right: Array, landmarks: Array) -> tuple[Array, Array]:
        """Solutions (N,m) and (p,3,m) for right sides of these shapes."""
        reduced, own = np.zeros_like(right), landmarks.copy()
        lift(self._rows, landmarks, reduced)
        reduced = cho_solve((self._factor, False), right - reduced, check_finite=False)
        lower(self._rows, reduced, own)
        return reduced, own

    def step(self) -> tuple[Array, Array, Array]:
        """The step (6 n,) of the controls, (s,) of the shared numbers, (p,3) of the landmarks."""
        own = np.empty((len(self._rows.precisions), 3))
        slopes(self._rows, own)
        reduced, landmarks = self.solve(-self._slope[:, None], -own[:, :, None])
        return reduced[: self._controls, 0], reduced[self._controls :, 0], landmarks[:, :, 0]

    def modes(self, normal: MapNormal, count: int) -> Array:
        """Independent errors (N,count) of controls and shared numbers, one deviation of each.

        All N of them have the covariance ``S^-1``; these are the ones by which landmarks that know
        nothing else of each other move the most, in their own deviations: the eigenvectors of
        ``H x = (1 + l) S x``, of which ``l`` is the squared sum of these moves. Fewer where these
        do not converge.
        """
        solve = partial(cho_solve, (self._factor, False), check_finite=False)
        shape = (self.size, self.size)

        def reduced(x: Array) -> Array:
            return np.asarray(dtrmv(self._factor, dtrmv(self._factor, x.ravel()), trans=1))

        start = np.random.default_rng(0).normal(size=self.size)  # the same images, the same map
        try:
            _, modes = eigsh(
                LinearOperator(shape, _information(normal), dtype=float),
                min(count, self.size - 1),
                LinearOperator(shape, reduced, dtype=float),
                Minv=LinearOperator(shape, solve, dtype=float),
                which="LA", v0=start, tol=_MODE_TOLERANCE,
            )  # fmt: skip
        except ArpackNoConvergence as stopped:  # after all the work that a map is: what there is
            modes = stopped.eigenvectors
        return np.asarray(modes[:, ::-1])

    def covariances(self) -> tuple[Array, Array]:
        """Of each landmark (p,3,3) and of the shared numbers (s,s); the factors are used up."""
        inverse, failed = dpotri(self._factor, lower=0, overwrite_c=1)
        if failed:
            raise Undetermined("the images do not determine map and motion")
        inverse, parts = inverse.T, np.array_split(_sequence(self._rows), _WORKERS)
        out = np.empty((len(self._rows.precisions), 3, 3))
        with ThreadPoolExecutor(_WORKERS) as workers:
            list(workers.map(lambda part: covariances(self._rows, part, inverse, out), parts))
        shared = np.tril(inverse[self._controls :, self._controls :])
        return out, shared + np.tril(shared, -1).T


def _sequence(rows: Rows) -> IntArray:
    """The landmarks (p,) by the first images that see them."""
    last = len(rows.order)
    seen = np.minimum(rows.starts[:-1], max(last - 1, 0))
    firsts = rows.first[rows.order[seen]] if last else rows.starts[:-1]
    return np.asarray(np.argsort(firsts, kind="stable"), np.int64)


def _dense(motion: Normal, damping: float) -> Array:
    """Lower triangle (N,N) of controls and shared numbers."""
    count = motion.band.shape[1]
    system = np.zeros((count + len(motion.corner),) * 2)
    for d in range(min(len(motion.band), count)):
        columns = np.arange(count - d)
        system[columns + d, columns] = motion.band[d, : count - d]
    system[count:, :count] = motion.cross.T
    system[count:, count:] = np.tril(motion.corner)
    diagonal = np.arange(len(system))
    system[diagonal, diagonal] *= 1.0 + damping
    return system


def _information(normal: MapNormal) -> Callable[[Array], Array]:
    """What multiplies (N,) with ``H``, the information that landmarks of known place would give."""
    motion = normal.motion.whole
    count = motion.band.shape[1]
    below = range(1, min(len(motion.band), count))
    lines = [motion.band[d, : count - d] for d in below]
    band = diags([motion.band[0], *lines, *lines], [0, *(-d for d in below), *below], format="csr")
    corner = np.tril(motion.corner) + np.tril(motion.corner, -1).T

    def times(x: Array) -> Array:
        own, shared = np.split(x.ravel(), [count])
        by_own = band @ own + motion.cross @ shared
        by_shared = motion.cross.T @ own + corner @ shared
        held: Array = normal.held @ (normal.held.T @ x.ravel())
        return np.concatenate([by_own, by_shared]) + held

    return times


class MapStep(NamedTuple):
    """Of all that is free."""

    controls: Array  # (6 n,)
    shared: Array  # (s,)
    landmarks: Array  # (p,3) m


class MapProblem:
    """The cost of a state with all landmarks free.

    Args:
        motion: what it would be if the map were known, with landmarks as they are known beforehand.
        start: first guess.
        deviations: (p,) m, of the landmarks as they are known beforehand.
        floating: nothing holds the whole but its start.
    """

    def __init__(self, motion: RigProblem, start: State, deviations: Array, floating: bool) -> None:
        self.motion, self.floating = motion, floating
        self.observations = joined([camera.observations for camera in motion.cameras])
        self._whole = Floating(start.spline, motion.border) if floating else None
        self._precisions = deviations**-2.0

    def noise(self, state: State, deviation: float) -> float:
        """Standard deviation of the noise, px."""
        return self.motion.noise(state, deviation)

    def normal(self, state: State, deviation: float) -> tuple[float, MapNormal]:
        """Cost and normal equations."""
        cost, motion = self.motion.normal(state, deviation)
        rows = self._rows(state, deviation)
        cost += float(np.sum(rows.precisions[:, None] * rows.offsets**2))
        held, error = np.zeros((len(motion.whole.slope) + self.motion.border, 0)), np.zeros(0)
        if self._whole is not None:
            held, error = self._whole.terms(state.spline)
            cost += float(error @ error)
        return cost, MapNormal(motion, rows, held, error)

    def _rows(self, state: State, deviation: float) -> Rows:
        every, firsts, seen = list[Array](), list[IntArray](), self.observations
        motion, border = self.motion, self.motion.border
        for camera, one, ratio, at in zip(
            motion.cameras, motion.states(state), motion.ratios, motion.columns, strict=True
        ):
            curve, parts = camera.look(one)
            terms = camera.terms(one, deviation * float(ratio))
            own = np.empty((len(camera.observations.points), 2, LOCAL + len(at) + 4))
            ends = np.cumsum([len(sights.first) for sights in parts])
            camera.each(partial(record, curve, terms), parts, np.split(own, ends[:-1]))
            firsts += [sights.first for sights in parts]
            every.append(own if len(at) == border else _spread(own, at, border))
        values, first = np.concatenate(every), np.concatenate(firsts)
        count = len(state.landmarks)
        return Rows(
            values,
            first,
            np.lexsort((first, seen.points)),
            np.concatenate([[0], np.cumsum(np.bincount(seen.points, minlength=count))]),
            self._precisions,
            state.landmarks - seen.landmarks,
            len(state.spline.positions),
            0.0,
        )

    def step(self, normal: MapNormal, damping: float) -> MapStep:
        """Levenberg's; raises Undetermined when the equations are not positive definite."""
        return MapStep(*Reduced(normal, damping).step())

    def moved(self, state: State, normal: MapNormal, step: MapStep) -> State:
        """The state after a step."""
        moved = self.motion.moved(state, normal.motion, (step.controls, step.shared))
        return moved.with_landmarks(state.landmarks + step.landmarks)


def _spread(own: Array, columns: IntArray, border: int) -> Array:
    """Rows (n,2,...) of a camera with the shared numbers of all."""
    rows = np.zeros((len(own), 2, LOCAL + border + 4))
    rows[..., :LOCAL], rows[..., LOCAL + columns], rows[..., -4:] = np.split(
        own, [LOCAL, LOCAL + len(columns)], axis=2
    )
    return rows


def joined(parts: Sequence[Observations]) -> Observations:
    """Those of all cameras, of one map, one after the other."""
    if len(parts) == 1:
        return parts[0]
    names = ("times", "row_times", "pixels", "points", "frames", "trusted")
    every: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in parts]) for name in names
    }
    return replace(parts[0], **every)


def sights_of(observations: Observations, inliers: BoolArray) -> tuple[IntArray, IntArray]:
    """How many keypoints (p,) and how many images (p,) show each landmark."""
    count = len(observations.landmarks)
    sights = np.bincount(observations.points[inliers], minlength=count)
    pairs = np.unique(
        np.column_stack([observations.points[inliers], observations.frames[inliers]]), axis=0
    )
    return sights, np.bincount(pairs[:, 0], minlength=count)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Map and motion in the frame of the map as it was given."""

    points: Array  # (p,3) m
    covariances: Array  # (p,3,3) m^2, inverse of the normal matrix
    shared: Array  # (s,s) covariance of readout time and lens, likewise
    spline: Spline


def apply_similarity(
    problem: MapProblem, state: State, deviation: float, usable: BoolArray
) -> Placed:
    """Lay the map over the given one, unless landmarks of known place hold it.

    Args:
        problem: whose minimum the state is.
        state: map and motion.
        deviation: px, of the noise.
        usable: (p,) which landmarks may hold the whole.

    Raises:
        Undetermined: when the images leave something open.
    """
    reduced = Reduced(problem.normal(state, deviation)[1])
    if not problem.floating:
        return Placed(state.landmarks, *reduced.covariances(), state.spline)
    given = problem.observations.landmarks
    whole, kept = laid_over(state.landmarks, given, usable)
    every = generators(state.landmarks, state.landmarks[kept].mean(axis=0))
    of_kept = np.where(kept[:, None, None], every, 0.0)
    spread = reduced.solve(np.zeros((reduced.size, 7)), of_kept)[1]
    covariances, shared = reduced.covariances()
    held = as_held(covariances, spread, every, of_kept)
    return Placed(
        whole(state.landmarks), whole.covariances(held), shared, whole.moved(state.spline)
    )
