# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is said of the augmented-reality experiment, held against its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.experiments import methods as m
from benchmarks.experiments.results import Claim, Statement
from benchmarks.experiments.uncertainty import Interval, bootstrap, share
from rs_localizer.core.arrays import Array, IntArray

QUANTILES = np.linspace(0.01, 0.99, 99)
_UPPER = QUANTILES[QUANTILES > 0.495]
_PAPER, _OURS = "paper: augmented reality", "ours"
_PRODUCT = "r6p_vcwt"
_FAST = 60.0  # deg/s
_SOON = 0.005  # s
# Errors beyond this (px), among them those of frames without a pose, are all the same.
_LOST = 1e3
_LOCALIZED, _BETTER, _FITS, _IN_TIME = 0.97, 3.0, 0.5, 0.95
_CUBE, _CUBE_WORST = 1.0, 3.0  # px, median and 95 %
# Images of the clip in a row are not independent: so many count as one.
_TOGETHER = 8


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """What all methods made of the frames that show three markers or more."""

    taken: int  # frames, these and those that show fewer
    speeds: Array  # (frames,) deg/s
    plain: Mapping[str, Array]  # method -> errors of all corners, px, of its best minimal models
    plain_owners: IntArray  # the frame of each of these corners
    products: Mapping[str, Array]  # solver -> the same of its Localizer
    owners: IntArray  # the frame of each of these
    positions: Mapping[str, Array]  # solver -> (frames,) m; infinite: not localized
    seconds: Mapping[str, Array]  # solver -> (frames,)
    cube: Mapping[str, Array]  # p3p and ours -> (images,) px, the cube's farthest corner


def claims(found: Frames) -> list[Claim]:
    """Verdicts in the order of the issue."""
    judges = (_plain, _r9p, _product, _localized, _position, _reprojection, _time, _cube)
    return [judge_one(found) for judge_one in judges]


def _worst_ratio(errors: Mapping[str, Array], p3p: str, chosen: IntArray) -> float:
    """The largest quantile from the median up, of any method, over that of P3P."""
    limits = _cut(errors[p3p][chosen])
    ratios = [
        # Where both are lost there is nothing to compare.
        np.where(np.minimum(values, limits) >= _LOST, 0.0, values / limits).max()
        for name, values in ((n, _cut(e[chosen])) for n, e in errors.items() if n != p3p)
    ]
    return float(max(ratios))


def _cut(errors: Array) -> Array:
    quantiles: Array = np.quantile(np.minimum(errors, _LOST), _UPPER, method="lower")
    return quantiles


def _under_p3p(errors: Mapping[str, Array], p3p: str, owners: IntArray) -> Interval:
    found = bootstrap(lambda chosen: _worst_ratio(errors, p3p, chosen), len(owners), owners)
    return replace(found, trials=len(np.unique(owners)))  # corners of a frame are one


def _ratio(interval: Interval) -> str:
    return f"at most {interval.value:.2f} ({interval.low:.2f} to {interval.high:.2f}) of P3P's"


def _medians(errors: Mapping[str, Array]) -> str:
    rows = (
        f"{name} {np.median(values):.2f} / {np.quantile(values, 0.9, method='lower'):.2f}"
        for name, values in errors.items()
    )
    return f"median / 90 % in px: {', '.join(rows)}"


def _plain(found: Frames) -> Claim:
    left_out = (m.R9P.name, m.R9P_OURS.name)
    errors = {name: each for name, each in found.plain.items() if name not in left_out}
    ratio = _under_p3p(errors, m.P3P.name, found.plain_owners)
    return Statement(
        "augmented-reality.plain",
        _PAPER,
        "The best minimal model of every rolling-shutter solver fits the markers better than P3P's",
        "under P3P in every quantile from the median to 99 % (100 samples, two walls or more)",
    ).judged_by(f"{_ratio(ratio)}; {_medians(errors)}", [ratio], (0.0, 1.0))


def _r9p(found: Frames) -> Claim:
    names = (m.P3P.name, m.R9P.name, m.R9P_OURS.name)
    errors = {name: found.plain[name] for name in names if name in found.plain}
    ratio = _under_p3p(errors, m.P3P.name, found.plain_owners)
    return Statement(
        "augmented-reality.r9p",
        _OURS,
        "So does that of R9P, by its own model, as published and with its trace fixed",
        "the same",
    ).judged_by(
        f"{_ratio(ratio)}; {_medians(errors)}",
        [ratio],
        (0.0, 1.0),
        "nine corners of a few markers are seldom in general position",
    )


def _product(found: Frames) -> Claim:
    ratio = _under_p3p(found.products, "p3p", found.owners)
    return Statement(
        "augmented-reality.localizer",
        _OURS,
        "With every rolling-shutter solver the Localizer fits the markers better than with P3P",
        "under P3P in every quantile from the median to 99 %, 100 samples, all frames",
    ).judged_by(f"{_ratio(ratio)}; {_medians(found.products)}", [ratio], (0.0, 1.0))


def _localized(found: Frames) -> Claim:
    shares = {s: share(np.isfinite(p)) for s, p in found.positions.items()}
    return Statement(
        "augmented-reality.localized",
        _OURS,
        "Frames that show three markers are localized",
        f"at least {_LOCALIZED:.0%} of them",
    ).judged_by(
        f"{shares[_PRODUCT].share()} of {len(found.speeds)}, P3P {shares['p3p'].share()} "
        f"({found.taken} frames in all)",
        [shares[_PRODUCT]],
        (_LOCALIZED, 1.0),
    )


def _position(found: Frames) -> Claim:
    fast = found.speeds > _FAST
    ours, p3p = (found.positions[s][fast] for s in (_PRODUCT, "p3p"))
    gain = bootstrap(
        lambda chosen: float(np.median(p3p[chosen]) / np.median(ours[chosen])), len(ours)
    )
    return Statement(
        "augmented-reality.position",
        _OURS,
        f"Faster than {_FAST:g} deg/s, positions are better than P3P's",
        f"median error at least {_BETTER:g} times smaller",
    ).judged_by(
        f"{1e3 * np.median(ours):.1f} mm against {1e3 * np.median(p3p):.0f} mm, {len(ours)} "
        f"frames: {gain.value:.1f} times ({gain.low:.1f} to {gain.high:.1f})",
        [gain],
        (_BETTER, np.inf),
    )


def _reprojection(found: Frames) -> Claim:
    errors = found.products[_PRODUCT]
    median = bootstrap(lambda chosen: float(np.median(errors[chosen])), len(errors), found.owners)
    return Statement(
        "augmented-reality.reprojection",
        _OURS,
        "The markers' corners fit the pose",
        f"median error below {_FITS:g} px",
    ).judged_by(
        f"{median.value:.3f} px ({median.low:.3f} to {median.high:.3f}), "
        f"P3P {np.median(found.products['p3p']):.2f} px",
        [median],
        (0.0, _FITS),
    )


def _time(found: Frames) -> Claim:
    seconds = found.seconds[_PRODUCT]
    soon = share(seconds < _SOON)
    return Statement(
        "augmented-reality.time",
        _PAPER,
        "An estimate with 100 RANSAC iterations takes less than 5 ms",
        f"{_IN_TIME:.0%} of the frames, least of three runs",
    ).judged_by(
        f"{soon.share()}, median {1e3 * np.median(seconds):.2f} ms",
        [soon],
        (_IN_TIME, 1.0),
        "the machine had other work, or is of another kind",
    )


def _cube(found: Frames) -> Claim:
    errors = found.cube["localizer"]
    blocks = np.arange(len(errors)) // _TOGETHER

    def at(quantile: float) -> Interval:
        return bootstrap(
            lambda chosen: float(np.quantile(errors[chosen], quantile, method="lower")),
            len(errors), blocks,
        )  # fmt: skip

    middle, worst = at(0.5), at(0.95)
    p3p = [float(np.quantile(found.cube["p3p"], q, method="lower")) for q in (0.5, 0.95)]
    return Statement(
        "augmented-reality.cube",
        _PAPER,
        "A cube stays in its place while the camera shakes",
        f"its farthest corner within {_CUBE:g} px in the median and {_CUBE_WORST:g} px in 95 % of "
        "the images",
    ).judged_by(
        f"{middle.value:.2f} ({middle.low:.2f} to {middle.high:.2f}) and {worst.value:.1f} "
        f"({worst.low:.1f} to {worst.high:.1f}) px, P3P {p3p[0]:.1f} and {p3p[1]:.0f} px, "
        f"{len(errors)} images",
        [middle.over(_CUBE), worst.over(_CUBE_WORST)],
        (0.0, 1.0),
    )
