# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of poses and twists against the truth, a picture of them, and ATE and RPE by evo."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import Motions, Trajectory

Stamps = NDArray[np.int64]
TOLERANCE_NS = 1_000_000
"""Largest difference of times that are compared: rounding, where both are of one image."""
UNITS = {
    "position": "m", "orientation": "deg", "angular velocity": "deg/s", "linear velocity": "m/s"
}  # fmt: skip
# They differ for everyone, and in lightness.
BLUE, ORANGE = "#0b3c8c", "#b8540a"
# Frames of the running median that is drawn through the single errors; zero has no logarithm.
_WINDOW, _LEAST = 15, 1e-9


class Errors(NamedTuple):
    """Errors of n poses or twists at the times of their estimates."""

    stamps_ns: Stamps  # (n,)
    values: Array  # (n,)


def associate(estimated: Stamps, true: Stamps) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Match times (n,) with the nearest of (m,), increasing, if it is near; return both rows.

    Both ns.
    """
    after = np.minimum(np.searchsorted(true, estimated), len(true) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(true[after] - estimated) < np.abs(estimated - true[before])
    nearest = np.where(nearer, after, before)
    rows = np.flatnonzero(np.abs(true[nearest] - estimated) <= TOLERANCE_NS)
    return rows, nearest[rows]


def errors_of(estimate: Motions, truth: Motions) -> dict[str, Errors]:
    """Return errors by quantity, in :data:`UNITS`; of twists if both have them."""
    rows, true_rows = associate(estimate.poses.stamps_ns, truth.poses.stamps_ns)
    poses, true = estimate.poses.part(rows), truth.poses.part(true_rows)
    turns = np.zeros(0)
    if len(rows):
        between = Rotation.from_quat(poses.quaternions).inv() * Rotation.from_quat(true.quaternions)
        turns = np.degrees(between.magnitude())
    values = {"position": _lengths(poses.positions - true.positions), "orientation": turns}
    found = {kind: Errors(poses.stamps_ns, each) for kind, each in values.items()}
    if estimate.twists is not None and truth.twists is not None:
        rows, true_rows = associate(estimate.twists.stamps_ns, truth.twists.stamps_ns)
        twists, moving = estimate.twists.part(rows), truth.twists.part(true_rows)
        rates = np.degrees(_lengths(twists.angular - moving.angular))
        found["angular velocity"] = Errors(twists.stamps_ns, rates)
        found["linear velocity"] = Errors(twists.stamps_ns, _lengths(twists.linear - moving.linear))
    return found


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1), np.float64)


def draw(methods: Mapping[str, Mapping[str, Errors]], path: Path) -> None:
    """Draw errors of one or two methods over time, on log scales, with running medians.

    The file's description holds the medians, so that a page can be compared with its picture.
    """
    from matplotlib.figure import Figure  # half a second

    kinds = [kind for kind in UNITS if any(kind in of for of in methods.values())]
    figure = Figure((10.0, 0.6 + 2.1 * len(kinds)), dpi=130, layout="constrained")
    panels = figure.subplots(len(kinds), 1, sharex=True, subplot_kw={"yscale": "log"})
    start, medians = min(of["position"].stamps_ns[0] for of in methods.values()), list[str]()
    for (name, of), color, marker in zip(methods.items(), (BLUE, ORANGE), ".x", strict=False):
        for kind in (kind for kind in kinds if kind in of and len(of[kind].values)):
            axes, t = panels[kinds.index(kind)], (of[kind].stamps_ns - start) * 1e-9
            values = np.maximum(of[kind].values, _LEAST)
            axes.plot(t, values, marker, color=color, markersize=3.0, alpha=0.35)
            running = median_filter(values, min(_WINDOW, len(values)), mode="mirror")
            label = f"{name}: median {np.median(values):.3g}, largest {values.max():.3g}"
            axes.plot(t, running, color=color, label=label)
            axes.set_ylabel(f"{kind}\n({UNITS[kind]})")
            axes.legend(
                loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
                borderaxespad=0.1,
            )  # fmt: skip
            medians.append(f"{kind} ({UNITS[kind]}), {name}: {np.median(values):.3g}")
    panels[-1].set_xlabel("time (s)")
    figure.savefig(path, metadata={"Description": "; ".join(medians)})


def by_evo(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Return ATE and RPE after Umeyama's alignment of the positions, by name and unit.

    Raises:
        ImportError: without evo.
        ValueError: where the positions lie on a line.
    """
    from evo.core import metrics, trajectory
    from evo.core.geometry import GeometryException

    rows, true_rows = associate(estimate.stamps_ns, truth.stamps_ns)
    true, estimated = (
        trajectory.PoseTrajectory3D(
            part.positions,
            np.roll(part.quaternions, 1, axis=1),  # evo puts w first
            (part.stamps_ns - estimate.stamps_ns[0]) * 1e-9,
        )
        for part in (truth.part(true_rows), estimate.part(rows))
    )
    try:
        estimated.align(true)
    except GeometryException as error:
        raise ValueError(f"--ate: positions on a line determine no alignment: {error}") from error
    parts = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    found = dict[str, float]()
    for name, metric in (("ATE", metrics.APE), ("RPE, next frame", metrics.RPE)):
        for unit, part in zip(("m", "deg"), parts, strict=True):
            measured = metric(part)
            measured.process_data((true, estimated))
            found[f"{name} ({unit} rms)"] = float(np.sqrt(np.mean(measured.error**2)))
    return found
