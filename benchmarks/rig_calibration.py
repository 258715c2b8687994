# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs that are calibrated from recordings, against their bounds:
``python -m benchmarks.rig_calibration``.

Two cameras of the independent simulator back to back in a hand, which never see the same, with
shutters against each other and clocks of their own. The bound is the inverse of the Fisher
information of the same pixels, by differences of the simulator's own: of a motion that is a cubic
spline with a knot for each image, of the mounting, the offset of the stamps of first rows and both
readout times; lenses are known to it. A second one knows the readout times as well.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse import coo_array

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera, Scan
from benchmarks.independent.motions import IntArray, Moving, hand
from benchmarks.independent.rigs import Mounted, Scene, Views, views
from benchmarks.independent.rotations import Array, exponential, logarithm
from rs_localizer.tools.adjust.observe import Observed
from rs_localizer.tools.calibration import calibrate
from rs_localizer.tools.rig import Recording, calibrate_rig

_RATE, _POINTS = 30.0, 76  # Hz; of each camera
_PHASE, _OFFSET = 0.0071, 0.0123  # s, of the second camera's images, and of its clock
_FIRST, _SECOND = Camera(focal=450.0), Camera(focal=450.0, readout_time=0.025, scan=Scan.UP)
_BACK = exponential(np.array([0.1, math.pi - 0.05, 0.05]))
_RIG = {
    "front": Mounted(_FIRST, np.eye(3), np.zeros(3)),
    "rear": Mounted(_SECOND, _BACK, np.array([0.03, 0.02, -0.1]), start=_PHASE),
}
_STEP = 1e-5  # rad, m, s
_NAMES = ("offset (us)", "rotation (mdeg)", "place (mm)")
_UNITS = np.array([1e6, 1e3 * math.degrees(1.0), 1e3])


@dataclass(frozen=True, slots=True, eq=False)
class _One:
    """The first of some motions at many times, turned (rad, body axes) and moved (m, map)."""

    motions: Moving
    turned: Array
    moved: Array

    def poses(self, which: IntArray, time: Array) -> tuple[Array, Array]:
        rotation, position = self.motions.poses(np.zeros_like(which), time)
        return rotation @ exponential(self.turned[None]), position + self.moved


def _columns(motions: Moving, mounted: Mounted, begin: Array, seen: Views) -> dict[str, Array]:
    """Derivatives (f,n,2,k) of pixels by pose, mounting, start and readout time."""

    def pixels(turned: Array, moved: Array, own: Mounted) -> Array:
        one = _One(motions, turned, moved)
        return own.seen(one, np.arange(len(begin)), begin, seen.points)  # type: ignore[arg-type]

    def by(change: int, step: float) -> Array:
        axis, nothing, camera = step * np.eye(3)[change % 3], np.zeros(3), mounted.camera
        if change < 3:
            return pixels(axis, nothing, mounted)
        if change < 6:
            return pixels(nothing, axis, mounted)
        if change < 9:  # a turn of the camera about its centre
            turn = exponential(axis)
            rotation, translation = turn @ mounted.rotation, turn @ mounted.translation
            own = replace(mounted, rotation=rotation, translation=translation)
        elif change < 12:
            own = replace(mounted, translation=mounted.translation - mounted.rotation @ axis)
        elif change == 12:
            own = replace(mounted, start=mounted.start + step)
        else:
            own = replace(mounted, camera=replace(camera, readout_time=camera.readout_time + step))
        return pixels(nothing, nothing, own)

    each = [(by(k, _STEP) - by(k, -_STEP)) / (2.0 * _STEP) for k in range(14)]
    all_ = np.stack(each, axis=-1)
    return {"pose": all_[..., :6], "mount": all_[..., 6:13], "readout": all_[..., 13:]}


def bounds(motions: Moving, begin: Array, seen: dict[str, Views], noise: float) -> Array:
    """Deviations (2,7) of offset, turn and place: with unknown and with known readout times."""
    spacing = 1.0 / _RATE
    last = begin[-1] + _PHASE + 0.04
    knots = spacing * np.arange(-3, math.ceil(last / spacing) + 4)
    controls = len(knots) - 4
    shared, rows = 9, 0
    data, row, column = [], [], []
    for place, (name, mounted) in enumerate(_RIG.items()):
        view, parts = seen[name], _columns(motions, mounted, begin, seen[name])
        frames, points = np.nonzero(view.visible)
        times = begin[frames] + mounted.start + mounted.camera.exposed(view.exact[frames, points])
        basis = BSpline.design_matrix(times, knots, 3).tocoo()
        weights, spans = basis.data.reshape(-1, 4), basis.col.reshape(-1, 4)
        pose = parts["pose"][frames, points]  # (m,2,6)
        own = np.zeros((len(frames), 2, shared))
        own[:, :, 7 + place] = parts["readout"][frames, points, :, 0]
        if place:
            own[:, :, :7] = parts["mount"][frames, points]
        values = np.einsum("mk,mac->makc", weights, pose).reshape(2 * len(frames), -1)
        at = (shared + 6 * spans[:, :, None] + np.arange(6)).reshape(len(frames), -1)
        count = 2 * len(frames)
        data += [values.ravel(), own.ravel()]
        column += [np.repeat(at, 2, axis=0).ravel(), np.tile(np.arange(shared), count)]
        numbers = rows + np.arange(count)
        row += [np.repeat(numbers, 24), np.repeat(numbers, shared)]
        rows += count
    design = coo_array(
        (np.concatenate(data), (np.concatenate(row), np.concatenate(column))),
        shape=(rows, shared + 6 * controls),
    ).tocsr()
    information = (design.T @ design).toarray() / noise**2
    inner = information[shared:, shared:] + 1e-6 * np.eye(6 * controls)  # ends that no point sees
    cross = information[:shared, shared:]
    outer = information[:shared, :shared] - cross @ np.linalg.solve(inner, cross.T)
    both = [np.linalg.inv(outer), np.linalg.inv(outer[:7, :7])]
    return np.sqrt([np.diag(one)[[6, 0, 1, 2, 3, 4, 5]] for one in both])


def _camera(camera: Camera) -> rsl.Camera:
    """With its lens; not its readout time."""
    size, scan = (camera.width, camera.height), str(camera.scan)
    return rsl.Camera(*size, camera.matrix, camera.distortion, scan_direction=scan)


def run(seconds: float, noise: float, outliers: float, seed: int) -> tuple[Array, Array, Array]:
    """Errors (7,) of offset, turn and place, their deviations (7,), and the bounds (2,7)."""
    rng = np.random.default_rng(seed)
    motions = hand(1, rng)
    begin = np.arange(0.0, seconds, 1.0 / _RATE)
    one = _One(motions, np.zeros(3), np.zeros(3))
    seen = views(_RIG, one, begin, _POINTS, Scene.RICH, rng)  # type: ignore[arg-type]
    recordings = {}
    for name, mounted in _RIG.items():
        clock = _OFFSET if mounted.start else 0.0
        images, view = [], seen[name]
        for frame, time in enumerate(begin):
            shown = view.visible[frame]
            pixels = view.exact[frame, shown]
            pixels = pixels + noise * rng.normal(size=pixels.shape)
            wrong = rng.uniform(size=len(pixels)) < outliers
            pixels[wrong] = rng.uniform([0, 0], [639, 479], (wrong.sum(), 2))
            stamp_ns = round(1e9 * (10.0 + time + mounted.start - clock))
            images.append(Observed(stamp_ns, view.points[frame, shown], pixels))
        camera = _camera(mounted.camera)
        recordings[name] = Recording(camera, calibrate(camera, images))
    found, truth = calibrate_rig(recordings)["rear"], _RIG["rear"]
    own, true_centre = found.extrinsics, -_BACK.T @ truth.translation
    turn = logarithm((own.axes @ _BACK.T)[None])[0]
    errors = np.r_[own.offset - _OFFSET, turn, own.centre - true_centre]
    return errors, np.roll(found.deviations, 1), bounds(motions, begin, seen, noise)


def _by_kind(squares: Array) -> Array:
    """Roots of means (...,3) of squares (...,7) of offset, turn and place."""
    parts = np.split(squares, [1, 4], axis=-1)
    roots: Array = np.sqrt(np.stack([part.mean(axis=-1) for part in parts], axis=-1))
    return roots


def main(arguments: list[str] | None = None) -> None:
    """Print the errors of each recording and the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rig_calibration", description="Calibrated rigs and their bounds."
    )
    parser.add_argument("--recordings", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--noise", type=float, default=1.0, metavar="PX")
    parser.add_argument("--outliers", type=float, default=0.2)
    parser.add_argument("--seed", type=int, default=0, help="of the first one")
    options = parser.parse_args(arguments)
    every = []
    for seed in range(options.seed, options.seed + options.recordings):
        every.append(run(options.seconds, options.noise, options.outliers, seed))
        errors, deviations, bound = every[-1]
        bound = bound / math.sqrt(1.0 - options.outliers)
        text = [
            f"{name}: {np.round(unit * part, 1).tolist()}"
            for name, unit, part in zip(_NAMES, _UNITS, np.split(errors, [1, 4]), strict=True)
        ]
        print(
            f"{seed}: {', '.join(text)}; by deviation {np.round(errors / deviations, 1).tolist()}, "
            f"bound {1e6 * bound[0, 0]:.1f} us, readout known {1e6 * bound[1, 0]:.1f} us",
            flush=True,
        )
    errors, deviations = (np.array([one[k] for one in every]) for k in range(2))
    bound = np.array([one[2][0] for one in every]) / math.sqrt(1.0 - options.outliers)
    print("| | bound | error / bound | deviation / bound | error / deviation | within two |")
    print("|---|---|---|---|---|---|")
    rms, inside = (
        _by_kind(np.mean((errors / bound) ** 2, axis=0)),
        np.abs(errors) < 2.0 * deviations,
    )
    typical = _by_kind(np.median(bound**2, axis=0)) * _UNITS
    wide = _by_kind(np.mean((deviations / bound) ** 2, axis=0))
    honest = _by_kind(np.mean((errors / deviations) ** 2, axis=0))
    for k, name in enumerate(_NAMES):
        held = np.split(inside, [1, 4], axis=1)[k].mean()
        print(
            f"| {name} | {typical[k]:.3g} | {rms[k]:.2f} | {wide[k]:.2f} | {honest[k]:.2f} | "
            f"{held:.0%} |"
        )


if __name__ == "__main__":
    main()
