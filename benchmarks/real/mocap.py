# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real mocap POSES TRUTH``: poses and twists before motion capture.

POSES is what ``replay`` has written, in any map; TRUTH a trajectory of any body that the camera is
fixed to, as TUM-RS' ``mav0/mocap0/data.csv`` (TUM's lines or EuRoC's, by one clock). Where the
camera sits on the body, where the map lies, and its scale are found from all poses, 13 numbers.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real.motion import Motion
from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import POSES_FILE, TWISTS_FILE, read_tum, read_twists

_NS = 1e-9
_FEWEST = 10  # poses within the truth
_STRIDE = 5  # poses between two whose turn tells how the camera is mounted


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Camera on the body, body's world in the map."""

    mounted: Rotation  # body_from_camera
    lever: Array  # (3,) m, camera in the body
    turned: Rotation  # map_from_world
    moved: Array  # (3,) in units of the map
    scale: float  # units of the map in a metre


def aligned(turns: Rotation, places: Array, truth: Motion, times: Array) -> Alignment:
    """Of poses map_from_camera at times (n,) s, least squares."""
    true_turns, true_places = truth.turns(times), truth.places(times)
    seen = (turns[:-_STRIDE].inv() * turns[_STRIDE:]).as_rotvec()
    moved = (true_turns[:-_STRIDE].inv() * true_turns[_STRIDE:]).as_rotvec()
    mounted, _ = Rotation.align_vectors(moved, seen)
    turned = (turns * mounted.inv() * true_turns.inv()).mean()
    matrix, count = turned.as_matrix(), len(times)
    by_lever = matrix @ true_turns.as_matrix()
    rows = np.concatenate(
        [(true_places @ matrix.T)[:, :, None], by_lever, np.tile(np.eye(3), (count, 1, 1))], axis=2
    )
    numbers, *_ = np.linalg.lstsq(rows.reshape(-1, 7), places.ravel(), rcond=None)
    scale = float(numbers[0])
    return Alignment(mounted, numbers[1:4] / scale, turned, numbers[4:], scale)


def errors(poses: Path, truth: Path) -> Array:
    """Errors (n,4) of a folder of ``replay``: deg, mm, deg/s, m/s.

    Raises:
        ValueError: where too few poses lie within the truth.
    """
    found, rates, known = (
        read_tum(poses / POSES_FILE),
        read_twists(poses / TWISTS_FILE),
        read_tum(truth),
    )
    start = int(known.stamps_ns[0])
    since: Array = _NS * (known.stamps_ns - start).astype(float)
    motion = Motion.of(since, Rotation.from_quat(known.quaternions), known.positions)
    _, own, of_rate = np.intersect1d(found.stamps_ns, rates.stamps_ns, return_indices=True)
    times: Array = _NS * (found.stamps_ns[own] - start).astype(float)
    within = (times > motion.start) & (times < motion.end)
    if np.count_nonzero(within) < _FEWEST:
        raise ValueError(
            f"{np.count_nonzero(within)} of {len(times)} poses lie within {truth}: is it by "
            "another clock?"
        )
    own, of_rate, times = own[within], of_rate[within], times[within]
    turns, places = Rotation.from_quat(found.quaternions[own]), found.positions[own]
    fit = aligned(turns, places, motion, times)
    true_turns, true_places = motion.turns(times), motion.places(times)
    expected = fit.scale * fit.turned.apply(true_places + true_turns.apply(fit.lever)) + fit.moved
    off = (fit.turned * true_turns * fit.mounted * turns.inv()).magnitude()
    angular = motion.turns(times, 1)
    linear = true_turns.inv().apply(motion.places(times, 1)) + np.cross(angular, fit.lever)
    back = fit.mounted.inv()
    return np.column_stack([
        np.degrees(off),
        1e3 * np.linalg.norm(places - expected, axis=1) / fit.scale,
        np.degrees(np.linalg.norm(rates.angular[of_rate] - back.apply(angular), axis=1)),
        np.linalg.norm(rates.linear[of_rate] / fit.scale - back.apply(linear), axis=1),
    ])  # fmt: skip


def main(argv: Sequence[str]) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real mocap", description=__doc__)
    parser.add_argument("poses", type=Path, nargs="+", help="folders of replay")
    parser.add_argument("truth", type=Path, help="trajectory of the body")
    args = parser.parse_args(argv)
    print("| | images | deg | mm | deg/s | m/s |\n|---|---|---|---|---|---|")
    for folder in args.poses:
        off = errors(folder, args.truth)
        cells = [f"{a:.3g}, {b:.3g}" for a, b in np.percentile(off, [50, 95], axis=0).T]
        print(f"| {folder.name} | {len(off)} | " + " | ".join(cells) + " |")
