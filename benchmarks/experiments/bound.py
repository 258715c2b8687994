# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the Localizer's estimate is as good as the points allow, and its covariance honest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from benchmarks.experiments import charts
from benchmarks.experiments.charts import Look
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.trials import Setting, camera
from benchmarks.experiments.uncertainty import Interval, quantile, share
from benchmarks.experiments.views import GROSS, Outcome, outcome, synthetic_views
from rs_localizer.config import Acceleration
from rs_localizer.core.arrays import Array
from rs_localizer.localizer import Localizer
from rs_localizer.tools.errors import BLUE, ORANGE

_REGION = 0.95
_COVERED = (0.93, 0.97)
_MOST_GROSS = 0.01
# A gross error whose own covariance still holds it possible, once in ten thousand, was announced.
_ANNOUNCED = float(chi2.ppf(0.9999, 12))


@dataclass(frozen=True, slots=True)
class Case:
    """Frames of one kind, and how near to the bound their median error has to be."""

    name: str
    label: str
    setting: Setting
    look: Look
    at_most: float = np.inf
    outliers: float = 0.0

    @property
    def at_rest(self) -> bool:
        return self.setting.angular == 0.0 and self.setting.linear == 0.0


# The least that can be set.
_NONE = Acceleration(angular=0.001, linear=0.001)
_CASES = (
    Case("fast", "50 points at 20 deg and 0.2 m", Setting(20.0, 0.2, 1.0),
         Look(BLUE, "", "-", 2.0), 1.05),
    Case("outliers", "200 points, 50 % outliers, at 10 deg and 0.1 m",
         Setting(10.0, 0.1, 1.0, points=200), Look("#2f6fc0", "", "--", 1.6), 1.05, outliers=0.5),
    Case("faster", "100 points at 30 deg and 0.3 m", Setting(30.0, 0.3, 1.0, points=100),
         Look("#5aa0e0", "", ":", 2.0), 1.08),
    Case("slow", "50 points at 1 deg and 0.01 m", Setting(1.0, 0.01, 1.0),
         Look("#2a6b34", "", "-.", 1.6), 1.05),
    Case("rest", "50 points at rest", Setting(noise=1.0), Look(ORANGE, "", "-", 1.4)),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The outcomes of one case."""

    case: Case
    outcomes: Sequence[Outcome]

    @property
    def errors(self) -> Array:
        """Squared errors (n,) in the metric of the bound that the case has."""
        return np.array([x.pose_bound if self.case.at_rest else x.bound for x in self.outcomes])

    @property
    def freedom(self) -> int:
        return 6 if self.case.at_rest else 12

    @property
    def ratio(self) -> Interval:
        """Median error in units of that of an estimate at the bound, as standard deviations."""
        found = np.sqrt(np.maximum(self.errors, 0.0) / chi2.ppf(0.5, self.freedom))
        return quantile(found)

    @property
    def coverage(self) -> Interval:
        """Share of the truths in the 95 % region of the covariance reported with a pose."""
        reported = np.array(
            [
                x.reported_pose if self.case.at_rest else x.reported
                for x in self.outcomes
                if x.localized
            ]
        )
        return share(reported < chi2.ppf(_REGION, self.freedom))

    @property
    def velocities_covered(self) -> float:
        reported = [x.reported_velocities for x in self.outcomes if x.localized]
        return float(np.mean(np.array(reported) < chi2.ppf(_REGION, 6)))

    @property
    def gross(self) -> float:
        return float(np.mean([x.gross for x in self.outcomes]))

    @property
    def refused(self) -> float:
        return float(np.mean([not x.localized for x in self.outcomes]))

    @property
    def lost(self) -> Interval:
        """Share without a pose that is right."""
        return share(np.array([x.gross or not x.localized for x in self.outcomes]))

    @property
    def overconfident(self) -> int:
        """Gross errors whose own covariance says that they cannot be."""
        return sum(x.gross and x.reported > _ANNOUNCED for x in self.outcomes)


def run(context: Context) -> Result:
    """The experiment."""
    localizer = Localizer(camera(), acceleration=_NONE)
    found = [Found(case, list(_outcomes(localizer, case, context))) for case in _CASES]
    return Result(
        "The bound",
        "The Localizer at its defaults, but told that nothing accelerates, as the bound is: "
        "velocities are constant (model B), 1 px noise on 1000 rows "
        f"and a field of view of 45 degrees, {context.trials} frames of each kind. Errors are "
        "measured in the metric of the Cramér-Rao bound: with the Fisher information of the true "
        "inliers at the true motion and the true pixels, in all 12 parameters. `ratio` is the root "
        "of their median over that of the chi-squared distribution, which an estimate at the bound "
        f"has; `gross` is more than {GROSS:g} sigma off.",
        [claim for one in found for claim in claims(one)] + [_overconfident(found)],
        {"bound": Table(_COLUMNS, [_row(one) for one in found])},
        {"bound": _figure(found)},
        [_WHY_REST],
    )


_COLUMNS = (
    "case", "points", "outliers", "deg_per_readout", "m_per_readout", "parameters", "ratio",
    "coverage_95", "velocity_coverage_95", "gross", "no_pose", "gross_with_small_covariance",
)  # fmt: skip
_WHY_REST = (
    "At rest the pose alone is judged, by its six-parameter bound and the 6x6 block of its "
    "covariance: the velocities are shrunk to zero, which is the truth here, while their "
    "covariance is deliberately left as the moving model found it (a slow motion that was not seen "
    "may still be there). So their region covers the truth always, and twelve parameters together "
    "would look too modest."
)


def _outcomes(localizer: Localizer, case: Case, context: Context) -> Iterator[Outcome]:
    views = synthetic_views(context.trials, context.seed, case.setting, case.outliers)
    for view in context.track(views, context.trials):
        yield outcome(view, localizer.localize(view.points, view.pixels))


def claims(found: Found) -> list[Claim]:
    """At the bound, calibrated, and no gross errors."""
    case = found.case
    low, high = _COVERED
    block = ", pose alone" if case.at_rest else ""
    listed = [
        Statement(
            f"bound.{case.name}_calibrated",
            "this project",
            f"the covariance is honest: {case.label}{block}",
            f"the {_REGION:.0%} region covers {low:.0%} to {high:.0%} of the truths",
        ).judged_by(found.coverage.share(), [found.coverage], _COVERED),
        Statement(
            f"bound.{case.name}_gross",
            "this project",
            f"hardly a pose is wrong: {case.label}",
            f"more than {GROSS:g} sigma off, or no pose: at most {_MOST_GROSS:.0%}",
        ).judged_by(
            f"{found.gross:.2%} off, {found.refused:.2%} without a pose",
            [found.lost],
            (0.0, _MOST_GROSS),
        ),
    ]
    if np.isfinite(case.at_most):
        listed.insert(
            0,
            Statement(
                f"bound.{case.name}",
                "this project",
                f"at the Cramér-Rao bound: {case.label}",
                f"median at most {case.at_most:g} of the bound's, as standard deviations",
            ).judged_by(f"{found.ratio.value:.3f}", [found.ratio], (-np.inf, case.at_most)),
        )
    return listed


def _overconfident(found: Sequence[Found]) -> Claim:
    gross = sum(outcome.gross for one in found for outcome in one.outcomes)
    hidden = sum(one.overconfident for one in found)
    total = sum(len(one.outcomes) for one in found)
    return Statement(
        "bound.none_hidden",
        "this project",
        "no gross error is published with a small covariance",
        "none outside the 99.99 % region of its own covariance",
    ).judged(f"{hidden} of {gross} gross errors in {total} frames", hidden == 0)


def _row(found: Found) -> tuple[str | float | int, ...]:
    case, setting = found.case, found.case.setting
    return (
        case.name, setting.points, case.outliers, setting.angular, setting.linear, found.freedom,
        found.ratio.value, found.coverage.value, found.velocities_covered, found.gross,
        found.refused, found.overconfident,
    )  # fmt: skip


def _figure(found: Sequence[Found]) -> Figure:
    drawn = charts.figure(6.8, 5.0)
    axes = drawn.subplots()
    levels = np.linspace(0.01, 0.99, 99)
    for one in found:
        expected = np.sqrt(chi2.ppf(levels, one.freedom))
        seen = np.sqrt(np.quantile(one.errors, levels, method="lower"))
        charts.line(axes, 100.0 * levels, seen / expected, one.case.look, one.case.label)
    axes.axhline(1.0, color="#000000", linewidth=0.8)
    axes.set_ylim(0.85, 1.25)
    charts.tidy(axes, "percentile of the frames", "error / error at the Cramér-Rao bound")
    axes.legend(frameon=False)
    return drawn
