# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks real gyro BAG``: turn rates before a real gyroscope, and a picture.

BAG has ``camera_info`` and correspondences, as ``detect`` writes them of a video of a board, and
``--gyroscope FILE`` is a text of lines ``t wx wy wz`` (s by the clock of the stamps, rad/s in the
camera's optical axes; with ``--align`` by another clock and in other axes). No estimator sees the
gyroscope. Beside twists there are the turns from pose to pose, of which estimators without a
shutter have some, too:

    python -m benchmarks real gyro rec --gyroscope gyroscope.txt -p readout_time:=0.0318 \\
        -p stamp_offset:=-0.0028
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks import command
from benchmarks.experiments.results import Table
from benchmarks.real.gyroscopes import Gyroscope, aligned, best_offset, in_images
from benchmarks.real.peers import PEERS, GlobalPose, solve_pnp_ransac
from benchmarks.real.recordings import Recording, add_settings, read_bag
from rs_localizer.cli.recording_input import given_settings
from rs_localizer.config import LocalizerConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.state import ANGULAR
from rs_localizer.core.types import Estimate
from rs_localizer.localizer import Localizer
from rs_localizer.tools.errors import BLUE, ORANGE
from rs_localizer.tracking import Tracker

_INSIDE = 7.815  # 95 % quantile of chi-squared with three degrees of freedom
_QUANTILE = 1.96  # of a normal number, both sides of 95 %
_NEAR = 1.0  # px
_AHEAD = (0.01, 0.03, 0.1)  # s after the middle of an image, for which the tracker is asked
_FASTEST = 15  # images
_NS = 1e-9
_MOMENT = 0.002  # s, half of what counts as one
_LAGS = (0, 1, 2)  # images that a tracked result waits for
SINGLE, TRACKED = "single", "tracked"
_LATER = f"{TRACKED}, 1 later"

Poses = Mapping[int, "Estimate | GlobalPose"]
"""By the place of the image."""


def localized(recording: Recording, config: LocalizerConfig) -> dict[str, Poses]:
    """Each image by each method."""
    camera, frames = recording.camera, recording.frames
    found: dict[str, Poses] = {}
    for name, peer in (PEERS | {"solvepnp": solve_pnp_ransac}).items():
        poses = [peer(camera, frame.points, frame.pixels) for frame in frames]
        found[name] = {k: pose for k, pose in enumerate(poses) if pose}
    localizer = Localizer(camera, config)
    single = [localizer.localize(frame.points, frame.pixels) for frame in frames]
    found[SINGLE] = {k: one for k, one in enumerate(single) if one}
    for lag in _LAGS:
        tracker = Tracker(Localizer(camera, config), output_lag=lag)
        at_once = [tracker.localize(each.middle_ns, each.points, each.pixels) for each in frames]
        results = [*at_once[lag:], *tracker.flush()]
        name = f"{TRACKED}, {lag} later" if lag else TRACKED
        found[name] = {k: one for k, one in enumerate(results) if one}
    return found


@dataclass(frozen=True, slots=True)
class Row:
    """What one method says of the recording; rates in deg/s."""

    localized: int
    between: tuple[float, float]  # turn between neighbours, median and 95 %
    central: tuple[float, float]  # central difference as turn rate of the image between
    twist: tuple[float, float] | None  # turn rate of the image
    claimed: float  # root mean square deviation of it
    ratio: float  # of it over the root mean square error
    inside: float  # share of the truths in 95 % regions
    near: float  # share of the points within a pixel
    near_fastest: float  # likewise in the fastest images


def judge(recording: Recording, gyroscope: Gyroscope, config: LocalizerConfig) -> Judged:
    """All methods before the gyroscope."""
    times = _NS * np.array([frame.middle_ns for frame in recording.frames])
    half = 0.5 * recording.camera.readout_time
    truth = gyroscope.mean_rate(times - half, times + half)
    fastest = np.argsort(-np.linalg.norm(truth, axis=1))[:_FASTEST]
    is_fast = np.zeros(len(times), np.bool_)
    is_fast[fastest] = True
    poses = localized(recording, config)
    rows = {
        name: _row(of, times, truth, is_fast, gyroscope, recording.camera.readout_time)
        for name, of in poses.items()
    }
    return Judged(times, truth, poses, rows)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """The table, and what it was made of."""

    times: Array  # (f,) s, of the middle rows
    truth: Array  # (f,3) rad/s
    poses: Mapping[str, Poses]
    rows: Mapping[str, Row]


def _row(
    poses: Poses, times: Array, truth: Array, is_fast: BoolArray, gyroscope: Gyroscope,
    readout_time: float,
) -> Row:  # fmt: skip
    near = {k: float(np.mean(np.asarray(one.residuals) < _NEAR)) for k, one in poses.items()}
    twist, claimed, ratio, inside = None, np.nan, np.nan, np.nan
    estimates = {k: one for k, one in poses.items() if isinstance(one, Estimate)}
    if estimates:
        rates, covariances = rates_of(estimates, readout_time)
        errors = rates - truth[list(estimates)]
        twist = _spread(errors)
        squared = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
        claimed = np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2)))
        ratio = float(claimed / np.sqrt(np.mean(np.sum(errors**2, axis=1))))
        inside = float(np.mean(squared < _INSIDE))
    places = [k for k in poses if k + 1 in poses]
    mean = gyroscope.mean_rate(times[places], times[np.array(places, int) + 1])
    between = np.array([_rate(poses, times, k, k + 1) for k in places]) - mean
    places = [k for k in poses if k - 1 in poses and k + 1 in poses]
    central = np.array([_rate(poses, times, k - 1, k + 1) for k in places]) - truth[places]
    return Row(
        len(poses), _spread(between), _spread(central), twist, float(np.rad2deg(claimed)), ratio,
        inside, float(np.mean(list(near.values()))),
        float(np.mean([value for k, value in near.items() if is_fast[k]])),
    )  # fmt: skip


def predicted(recording: Recording, gyroscope: Gyroscope, config: LocalizerConfig) -> list[str]:
    """Lines of turn rates that ``Tracker.at`` predicts, before those of that moment."""
    tracker = Tracker(Localizer(recording.camera, config))
    errors: dict[float, list[tuple[Array, Array]]] = {ahead: [] for ahead in _AHEAD}
    for each in recording.frames:
        tracker.localize(each.middle_ns, each.points, each.pixels)
        for ahead, of in errors.items():
            if there := tracker.at(each.middle_ns + round(1e9 * ahead)):
                time = np.array([_NS * each.middle_ns + ahead])
                (rate,), (covariance,) = rates_of({0: there}, recording.camera.readout_time)
                of.append(
                    (rate - gyroscope.mean_rate(time - _MOMENT, time + _MOMENT)[0], covariance)
                )
    lines = []
    for ahead, of in errors.items():
        inside = np.mean([off @ np.linalg.solve(spread, off) < _INSIDE for off, spread in of])
        median, high = _spread(np.array([off for off, _ in of]))
        lines.append(f"predicted {1e3 * ahead:.0f} ms ahead: {median:.2f}, {high:.1f} deg/s, "
                     f"{inside:.0%} inside")  # fmt: skip
    return lines


def agreement(judged: Judged, gyroscope: Gyroscope, readout_time: float) -> str:
    """A line: how like the gyroscope the tracked twists are, and at which offset of the clocks.

    Twists are of single images: stamps of a neighbouring image, which turns from pose to pose let
    pass as a slow clock, show here.
    """
    found = {k: one for k, one in judged.poses[_LATER].items() if isinstance(one, Estimate)}
    rates, _ = rates_of(found, readout_time)
    times, half = judged.times[list(found)], 0.5 * readout_time
    offset, likeness = best_offset(
        rates, lambda later: gyroscope.mean_rate(times - half - later, times + half - later)
    )
    return (
        f"twists are most like the gyroscope at {in_images(offset, judged.times)}: {likeness:.3f}"
    )


def rates_of(estimates: Mapping[int, Estimate], readout_time: float) -> tuple[Array, Array]:
    """Turn rates (n,3) rad/s of estimates, and their covariances (n,3,3)."""
    rates = np.array([one.angular_velocity for one in estimates.values()]) / readout_time
    covariances = np.array([one.covariance[ANGULAR, ANGULAR] for one in estimates.values()])
    return rates, covariances / readout_time**2


def _rate(poses: Poses, times: Array, first: int, last: int) -> Array:
    turn = so3.log(np.ascontiguousarray(poses[first].rotation @ poses[last].rotation.T))
    return np.asarray(turn / (times[last] - times[first]))


def _spread(errors: Array) -> tuple[float, float]:
    """Median and 95 % quantile of errors (n,3) rad/s, in deg/s."""
    if not len(errors):
        return np.nan, np.nan
    median, high = np.rad2deg(np.percentile(np.linalg.norm(errors, axis=1), [50, 95]))
    return float(median), float(high)


_HEADINGS = (
    "", "localized", "turns", "central", "twist", "claims", "ratio", "inside", "1px", "fast",
)  # fmt: skip


def table(judged: Judged) -> Table:
    """Errors in deg/s, median and 95 %: of turns between neighbours, of central differences and
    of twists; shares in %.
    """

    def pair(values: tuple[float, float] | None) -> str:
        return "" if values is None else f"{values[0]:.2f}, {values[1]:.1f}"

    def number(value: float, form: str) -> str:
        return "" if np.isnan(value) else format(value, form)

    return Table(_HEADINGS, [
        (
            name, f"{row.localized}/{len(judged.times)}", pair(row.between), pair(row.central),
            pair(row.twist), number(row.claimed, ".1f"), number(row.ratio, ".2f"),
            number(100.0 * row.inside, ".0f"), f"{row.near:.3f}", f"{row.near_fastest:.3f}",
        )
        for name, row in judged.rows.items()
    ])  # fmt: skip


def draw(judged: Judged, gyroscope: Gyroscope, readout_time: float, file: Path) -> None:
    """Turn rates of tracked images with their 95 % bars on the gyroscope's line; single ones small.

    The bars of single images would hide the line: the table has what they claim.
    """
    start, times = judged.times[0], gyroscope.times
    shown = (times > start) & (times < judged.times[-1])
    figure = Figure(figsize=(9, 6), layout="constrained", dpi=100)
    panels = figure.subplots(3, 1, sharex=True)
    rates, covariances = {}, {}
    found = {
        name: {k: one for k, one in judged.poses[name].items() if isinstance(one, Estimate)}
        for name in (SINGLE, _LATER)
    }
    for name, of in found.items():
        rates[name], covariances[name] = rates_of(of, readout_time)
    bars = _QUANTILE * np.sqrt(np.diagonal(covariances[_LATER], axis1=1, axis2=2))
    for k, panel in enumerate(panels):
        panel.plot(
            times[shown] - start, np.rad2deg(gyroscope.rates[shown, k]), color="0.35",
            linewidth=1.0, label="gyroscope (no estimator sees it)",
        )  # fmt: skip
        panel.plot(
            judged.times[list(found[SINGLE])] - start, np.rad2deg(rates[SINGLE][:, k]), ".",
            color=ORANGE, markersize=4, label="one image alone",
        )  # fmt: skip
        panel.errorbar(
            judged.times[list(found[_LATER])] - start, np.rad2deg(rates[_LATER][:, k]),
            np.rad2deg(bars[:, k]), fmt="o", color=BLUE, markersize=4, linewidth=1.0, capsize=2,
            label="tracked, one image later, with 95 %",
        )  # fmt: skip
        panel.set_ylabel(f"{'xyz'[k]} (deg/s)")
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].legend(loc="upper right", fontsize="small", ncols=3)
    panels[-1].set_xlabel("time (s)")
    figure.savefig(file)


def main(argv: Sequence[str]) -> None:
    """Run it."""
    parser = command(".real gyro", __doc__)
    parser.add_argument("recording", type=Path, help="a bag")
    parser.add_argument("--gyroscope", type=Path, required=True, help="t wx wy wz, held back")
    parser.add_argument("--align", action="store_true", help="find its clock, axes and bias")
    parser.add_argument("--out", type=Path, default=Path("real"), help="picture")
    add_settings(parser)
    args = parser.parse_args(argv)
    config = given_settings(args)
    args.out.mkdir(parents=True, exist_ok=True)
    recording, gyroscope = read_bag(args.recording, config), Gyroscope.read(args.gyroscope)
    if args.align:
        gyroscope, said = aligned(gyroscope, recording)
        print(said, file=sys.stderr)
    judged = judge(recording, gyroscope, config)
    readout_time = recording.camera.readout_time
    print(table(judged).text(), *predicted(recording, gyroscope, config), sep="\n")
    print(agreement(judged, gyroscope, readout_time))
    draw(judged, gyroscope, readout_time, args.out / "gyro.png")
