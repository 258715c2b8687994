# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All benches as one experiment: what is claimed of covariances and of P3P, with a verdict.

A condition on its own has too few frames to tell 92 from 95 %. So each claim is judged by all of
its conditions together, and falls, too, with any single condition that is certainly worse; the
confidence of the single ones allows for their number.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.uncertainty import IntArray, Interval, share, together
from benchmarks.honesty.against_p3p import MOST_RATIO, Pair
from benchmarks.honesty.benches import Bench, benches, table
from benchmarks.honesty.estimating import Found
from benchmarks.honesty.scores import Scores, percent
from benchmarks.honesty.tags import Replayed
from rs_localizer.core.arrays import BoolArray

_SOURCE = "this project"
_LEAST_INSIGNIFICANT = 0.93
_HOLD = (0.92, 0.98)
_PARTS = {"pose": "poses", "twist": "twists"}

Hits = Mapping[str, tuple[BoolArray, IntArray]]
"""Of each condition, whether something was so in each frame, and the frame's recording."""


def p3p_claims(found: Mapping[str, Pair]) -> list[Claim]:
    """Errors, refusals, and motion where there is none."""
    claims = [
        _ratio(f"honesty.p3p_{label}", label, quantile, found)
        for label, quantile in (("median", 0.5), ("95", 0.95))
    ]
    ours, theirs = (
        sum(int(np.count_nonzero(~getattr(pair, name).localized)) for pair in found.values())
        for name in ("ours", "p3p")
    )
    claims.append(
        Statement(
            "honesty.p3p_refused",
            _SOURCE,
            "the default refuses no more frames than P3P",
            "of the frames that one of them refuses, at most half are the default's",
        ).judged_by(f"{ours} and {theirs} refused", [_refused_by_us(found.values())], (0.0, 0.5))
    )
    still = {
        name: (pair.insignificant, pair.ours.groups())
        for name, pair in found.items()
        if "/0ms/" in name
    }
    claims.append(
        _family(
            "honesty.global_shutter",
            "a global shutter stays one, whatever is wrong with map, lens and readout time",
            "of its frames the velocities are insignificant in",
            still,
            (_LEAST_INSIGNIFICANT, 1.0),
        )
    )
    return claims


def tag_claims(found: Mapping[str, Replayed]) -> list[Claim]:
    """A real global shutter: one recording, which is as it is."""
    p3p = found["p3p"]
    others = {name: one for name, one in found.items() if name != "p3p"}

    def jitter(one: Replayed) -> tuple[float, float]:
        return float(np.median(one.jitter)), float(np.quantile(one.jitter, 0.95))

    listed = [
        f"{name} {jitter(one)[0]:.2f} and {jitter(one)[1]:.2f}" for name, one in found.items()
    ]
    shares = {name: percent(one.insignificant) for name, one in others.items()}
    return [
        Statement(
            "honesty.tags_jitter",
            _SOURCE,
            "before real tags a real global shutter's poses jitter no more than P3P's",
            "second difference of the orientation, median and 95 %: not above P3P's",
        ).judged(
            f"{', '.join(listed)} deg",
            all(
                ours <= theirs
                for one in others.values()
                for ours, theirs in zip(jitter(one), jitter(p3p), strict=True)
            ),
        ),
        Statement(
            "honesty.tags_velocities",
            _SOURCE,
            "no motion is found within its frames",
            f"velocities are insignificant in at least {_LEAST_INSIGNIFICANT:.0%}",
        ).judged(
            ", ".join(f"{name} {value:.1f} %" for name, value in shares.items()),
            all(value >= 100.0 * _LEAST_INSIGNIFICANT for value in shares.values()),
        ),
    ]


def rendered_claims(found: Mapping[str, Found]) -> list[Claim]:
    """Through renderer, detector and node."""
    return [
        _regions(f"honesty.rendered_{part}", f"rendered markers: 95 % regions of {noun}", part,
                 found, _HOLD)
        for part, noun in _PARTS.items()
    ]  # fmt: skip


def _regions(
    name: str, what: str, part: str, found: Mapping[str, Found], limits: tuple[float, float]
) -> Claim:
    hits = {
        condition: (scores.inside(part), scores.groups())
        for condition, scores in _at_both_moments(found)
    }
    return _family(name, f"{what} hold", "they hold the truth in", hits, limits)


def _at_both_moments(found: Mapping[str, Found]) -> Iterator[tuple[str, Scores]]:
    for condition, one in found.items():
        yield f"{condition} at stamp", one.stamp
        yield f"{condition} at mid-frame", one.middle


def _family(
    name: str, statement: str, criterion: str, hits: Hits, limits: tuple[float, float]
) -> Claim:
    """All conditions together lie within the limits, and none is certainly on their bad side."""
    low, high = limits
    several = together(len(hits))
    single = {condition: share(*each, several) for condition, each in hits.items() if len(each[0])}
    pooled = share(*_pooled(hits))
    # Limits at 0 and 1 are none; between two, too small a share is what misleads.
    bad_side = (0.0, high) if low == 0.0 else (low, 1.0)
    sign = -1.0 if low == 0.0 else 1.0
    certain = [condition for condition, one in single.items() if one.outside(*bad_side)]
    worst = min(certain or single, key=lambda condition: sign * single[condition].value)
    wanted = f"at most {high:.0%}" if low == 0.0 else f"{low:.0%} to {high:.0%}"
    return Statement(
        name,
        _SOURCE,
        statement,
        f"{criterion} {wanted} of all frames, and under no condition is it certainly worse",
    ).judged_by(
        f"{pooled.share()}; certainly worse under {len(certain)} of {len(single)} conditions; "
        f"worst: {100 * single[worst].value:.0f} %, {worst}",
        [single[worst]] if certain else [pooled],
        bad_side if certain else limits,
    )


def _pooled(hits: Hits) -> tuple[BoolArray, IntArray]:
    """All conditions as one: recordings of one number share motion and noise, and are one group."""
    return (
        np.concatenate([each for each, _ in hits.values()]),
        np.concatenate([groups for _, groups in hits.values()]),
    )


def _ratio(name: str, label: str, quantile: float, found: Mapping[str, Pair]) -> Claim:
    several = together(len(found))
    ratios = {
        condition: pair.ratio(quantile, confidence=several)
        for condition, pair in found.items()
        if np.any(pair.both)
    }
    worst = max(ratios, key=lambda condition: ratios[condition].value)
    above = sum(ratio.outside(0.0, MOST_RATIO) for ratio in ratios.values())
    figure = "median" if label == "median" else "95 %"
    return Statement(
        name,
        _SOURCE,
        "before boards and markers whose map or lens is a little off, the default is never worse "
        f"than P3P: {figure} of the orientation error",
        f"at most {MOST_RATIO:g} times P3P's, under every condition",
    ).judged_by(
        f"certainly above under {above} of {len(ratios)}; worst {ratios[worst].value:.2f} times, "
        f"{worst}",
        list(ratios.values()),
        (0.0, MOST_RATIO),
    )


def _refused_by_us(pairs: Iterable[Pair]) -> Interval:
    """Share of ours among the frames that only one of the two refuses."""
    only: list[BoolArray] = []
    groups: list[IntArray] = []
    for pair in pairs:
        one = pair.ours.localized != pair.p3p.localized
        only.append(~pair.ours.localized[one])
        groups.append(pair.ours.recordings[one])
    hits = np.concatenate(only)
    return share(hits, np.concatenate(groups)) if len(hits) else Interval(0.0, 0.0, 0.0, 0)


_MOST_FRAMES = 100  # of a condition
_JUDGE: Mapping[str, Callable[[Mapping[str, Any]], list[Claim]]] = {
    "p3p": p3p_claims,
    "tags": tag_claims,
    "rendered": rendered_claims,
}


def run(context: Context) -> Result:
    """The experiment."""
    frames = min(context.trials, _MOST_FRAMES)
    judged: list[Claim] = []
    tables: dict[str, Table] = {}
    with tempfile.TemporaryDirectory() as folder:
        all_of_them = benches(Path(folder))
        for name, judge in _JUDGE.items():
            bench = all_of_them[name]
            found = _run(bench, context, frames)
            judged += judge(found)
            rows = [bench.row(condition, one) for condition, one in found.items()]
            tables[f"honesty_{name}"] = Table(bench.columns, rows)
    return Result(
        "Honesty",
        f"Defaults, {frames} frames of each condition: boards and markers with maps and lenses "
        "that are a little off, against P3P, made by a simulator that shares no code with the "
        "estimator (short recordings at 30 Hz, 640x480, a lens with distortion); a recording of a "
        "real global shutter; rendered walls of markers along recorded hands, through detector and "
        "node. Shares in the tables are in %, of the frames with a pose.",
        judged,
        tables,
        notes=[table(one.columns, one.rows) for one in tables.values()],
    )


def _run(bench: Bench[Any, Any], context: Context, frames: int) -> dict[str, Any]:
    conditions = bench.conditions
    each = bench.run(conditions, frames, context.seed)
    return dict(context.track(each, len(conditions)))
