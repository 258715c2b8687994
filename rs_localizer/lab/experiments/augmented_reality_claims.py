"""What is said of the augmented-reality experiment, held against its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.lab.experiments import methods as m
from rs_localizer.lab.experiments.results import Claim, judge

QUANTILES = np.linspace(0.01, 0.99, 99)
_UPPER = QUANTILES[QUANTILES > 0.495]
_PAPER, _OURS = "paper: augmented reality", "ours"
_PRODUCT = "r6p_vcwt"
_FAST = 60.0  # deg/s
_SOON = 0.005  # s


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """What all methods made of the frames that show three markers or more."""

    taken: int  # frames, these and those that show fewer
    speeds: Array  # (frames,) deg/s
    plain: Mapping[str, Array]  # method -> errors of all corners, px, of its best minimal models
    products: Mapping[str, Array]  # solver -> the same of its Localizer
    positions: Mapping[str, Array]  # solver -> (frames,) m; infinite: not localized
    seconds: Mapping[str, Array]  # solver -> (frames,)
    cube: Mapping[str, Array]  # p3p and ours -> (images,) px, the cube's farthest corner


def claims(found: Frames) -> list[Claim]:
    """Verdicts in the order of the issue."""
    judges = (_plain, _published_r9p, _product, _localized, _position, _reprojection, _time, _cube)
    return [judge_one(found) for judge_one in judges]


def _share_below(errors: Mapping[str, Array], p3p: str) -> dict[str, float]:
    """In which share of the quantiles from the median up each method is under P3P."""
    limit = np.quantile(errors[p3p], _UPPER, method="lower")
    return {
        name: float(np.mean(np.quantile(values, _UPPER, method="lower") < limit))
        for name, values in errors.items()
        if name != p3p
    }


def _medians(errors: Mapping[str, Array]) -> str:
    rows = (
        f"{name} {np.median(values):.2f} / {np.quantile(values, 0.9, method='lower'):.2f}"
        for name, values in errors.items()
    )
    return f"median / 90 % in px: {', '.join(rows)}"


def _plain(found: Frames) -> Claim:
    published = m.R9P.name
    shares = _share_below({k: v for k, v in found.plain.items() if k != published}, m.P3P.name)
    above = [name for name, share in shares.items() if share < 1.0]
    return judge(
        "augmented-reality.plain",
        _PAPER,
        "The best minimal model of every rolling-shutter solver fits the markers better than P3P's",
        "under P3P in every quantile from the median to 99 % (100 samples, two walls or more); "
        "R9P with its trace fixed",
        _medians(found.plain),
        not above,
        f"{', '.join(above)} is not",
    )


def _published_r9p(found: Frames) -> Claim:
    both = {name: found.plain[name] for name in (m.P3P.name, m.R9P.name)}
    share = _share_below(both, m.P3P.name)[m.R9P.name]
    return judge(
        "augmented-reality.r9p_published",
        _PAPER,
        "So does that of R9P as published",
        "the same",
        f"{_medians(both)}; under P3P in {100 * share:.0f} % of the quantiles",
        share == 1.0,
        "its gauge (see motion.r9p_gauge) costs most where the camera hardly moves, and nine "
        "corners of a few markers are seldom in general position",
    )


def _product(found: Frames) -> Claim:
    shares = _share_below(found.products, "p3p")
    return judge(
        "augmented-reality.localizer",
        _OURS,
        "With every rolling-shutter solver the Localizer fits the markers better than with P3P",
        "under P3P in every quantile from the median to 99 %, 100 samples, all frames",
        _medians(found.products),
        min(shares.values()) == 1.0,
    )


def _localized(found: Frames) -> Claim:
    shares = {s: float(np.mean(np.isfinite(p))) for s, p in found.positions.items()}
    count = len(found.speeds)
    return judge(
        "augmented-reality.localized",
        _OURS,
        "Frames that show three markers are localized",
        "at least 97 % of them",
        f"{100 * shares[_PRODUCT]:.1f} % of {count}, P3P {100 * shares['p3p']:.1f} % "
        f"({found.taken} frames in all)",
        shares[_PRODUCT] >= 0.97,
    )


def _position(found: Frames) -> Claim:
    fast = found.speeds > _FAST
    ours, p3p = (float(np.median(found.positions[s][fast])) for s in (_PRODUCT, "p3p"))
    return judge(
        "augmented-reality.position",
        _OURS,
        f"Faster than {_FAST:g} deg/s, positions are better than P3P's",
        "median error at least 3 times smaller",
        f"{1e3 * ours:.1f} mm against {1e3 * p3p:.0f} mm, {np.count_nonzero(fast)} frames",
        3.0 * ours <= p3p,
    )


def _reprojection(found: Frames) -> Claim:
    ours, p3p = (float(np.median(found.products[s])) for s in (_PRODUCT, "p3p"))
    return judge(
        "augmented-reality.reprojection",
        _OURS,
        "The markers' corners fit the pose",
        "median error below 0.5 px",
        f"{ours:.3f} px, P3P {p3p:.2f} px",
        ours < 0.5,
    )


def _time(found: Frames) -> Claim:
    seconds = found.seconds[_PRODUCT]
    share = float(np.mean(seconds < _SOON))
    return judge(
        "augmented-reality.time",
        _PAPER,
        "An estimate with 100 RANSAC iterations takes less than 5 ms",
        "95 % of the frames, least of three runs",
        f"{100 * share:.1f} %, median {1e3 * np.median(seconds):.2f} ms",
        share >= 0.95,
    )


def _cube(found: Frames) -> Claim:
    rows = {
        name: (float(np.median(values)), float(np.quantile(values, 0.95, method="lower")))
        for name, values in found.cube.items()
    }
    (ours, our_worst), (p3p, p3p_worst) = rows["localizer"], rows["p3p"]
    return judge(
        "augmented-reality.cube",
        _PAPER,
        "A cube stays in its place while the camera shakes",
        "its farthest corner within 1 px in the median and 3 px in 95 % of the images",
        f"{ours:.2f} and {our_worst:.1f} px, P3P {p3p:.1f} and {p3p_worst:.0f} px, "
        f"{len(found.cube['p3p'])} images",
        ours <= 1.0 and our_worst <= 3.0,
    )
