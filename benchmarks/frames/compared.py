# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Two versions on the same frames: what is certainly better or worse."""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest
from scipy.stats import t as student

from benchmarks.frames.judged import FIGURES, REGION, Judged, far_off, quantile, sharpness
from benchmarks.independent.rotations import Array

BoolArray = NDArray[np.bool_]

# One condition in a hundred is called certain by chance, and as often better as worse.
_CHANCE = 0.01
_RESAMPLES = 1000
# Certain and smaller than this is certain, and of no interest: share of an error.
_WORTH_A_LINE = 0.02
_ERRORS = {"deg@s": "deg_s", "deg": "deg", "mm": "mm", "deg/s": "deg/s", "m/s": "m/s"}
_SHARP = ("turn_s", "turn", "way", "angular", "linear")
_SHARES = ("localized", "pose@s", "pose@m", "twist@m", "in/ref", "not>5s")


@dataclass(frozen=True)
class Change:
    """One figure of both versions; ``sign`` 1: certainly better, -1: worse, 0: who knows."""

    before: float
    after: float
    low: float  # interval of the ratio of an error; NaN of a share
    high: float
    sign: int


def compare(options: argparse.Namespace) -> int:
    """The command; 1 if anything is certainly worse."""
    before, after = read(options.before), read(options.after)
    names = [name for name in before if name in after]
    if not names:
        sys.stderr.write("the tables have no condition in common\n")
        return 2
    changes: dict[str, dict[str, Change]] = {}
    for name in names:
        one, other = before[name], after[name]
        if len(one.reasons) != len(other.reasons) or np.any(
            one.of("recording") != other.of("recording")
        ):
            sys.stderr.write(f"{name}: frames differ; take the same --seed and --frames\n")
            return 2
        changes[name] = changes_of(one, other)
    width = max(map(len, names))
    for name, figures in changes.items():
        notable = any(change.sign for change in figures.values())
        if notable or options.all:
            sys.stdout.write(f"{name:{width}}  {_line(figures, options.all)}\n")
    _write_totals(before, after, changes)
    return int(any(change.sign < 0 for each in changes.values() for change in each.values()))


def write(table: Path, judged: Mapping[str, Judged], **others: ArrayLike) -> None:
    """The frames of conditions by ``bench/condition``, and other arrays, beside their table."""
    kept: dict[str, ArrayLike] = {
        "names": list(judged),
        "counts": [len(one.reasons) for one in judged.values()],
        "figures": np.concatenate([one.figures for one in judged.values()]),
        "reasons": np.concatenate([one.reasons for one in judged.values()]),
    }
    np.savez_compressed(table.with_suffix(".npz"), **(kept | others))  # type: ignore[arg-type]


def read(table: Path) -> dict[str, Judged]:
    """The frames beside a table, by ``bench/condition``."""
    kept = np.load(table.with_suffix(".npz"))
    ends = np.cumsum(kept["counts"])[:-1]
    parts = zip(np.split(kept["figures"], ends), np.split(kept["reasons"], ends), strict=True)
    return {
        str(name): Judged(figures, [str(reason) for reason in reasons])
        for name, (figures, reasons) in zip(kept["names"], parts, strict=True)
    }


def changes_of(before: Judged, after: Judged) -> dict[str, Change]:
    """Every figure that is compared, by its name."""
    found = _shares(before, after)
    both = before.localized & after.localized
    for name, figure in _ERRORS.items():
        errors = [one.of(figure)[both] for one in (before, after)]
        if len(errors[0]) and np.isfinite(errors[0]).all() and np.isfinite(errors[1]).all():
            found[name] = _error(errors[0], errors[1], before.of("recording")[both])
    taken = [quantile(one.of("ms"), 0.5) for one in (before, after)]
    found["ms"] = Change(taken[0], taken[1], np.nan, np.nan, 0)
    return found


def _hits(judged: Judged) -> dict[str, tuple[BoolArray, BoolArray]]:
    """Which frames are right, and which count, by the name of the share."""
    some, every = judged.localized, np.ones(len(judged.reasons), np.bool_)
    twists = some & np.isfinite(judged.of("deg/s"))
    inside = {name: judged.of(name) < REGION for name in ("pose_s", "pose", "twist")}
    return {
        "localized": (some, every),
        "pose@s": (inside["pose_s"], some),
        "pose@m": (inside["pose"], some),
        "twist@m": (inside["twist"], twists),
        "in/ref": (inside["pose"] | ~some, every),
        "not>5s": (~far_off(judged), every),
    }


def _shares(before: Judged, after: Judged) -> dict[str, Change]:
    """The shares that both have, by their names."""
    hits, recording = [_hits(one) for one in (before, after)], before.of("recording")
    every = {name: _share(hits[0][name], hits[1][name], recording) for name in _SHARES}
    return {name: change for name, change in every.items() if change is not None}


def _share(
    before: tuple[BoolArray, BoolArray], after: tuple[BoolArray, BoolArray], recording: Array
) -> Change | None:
    """Recording by recording: does the second have more right ones (McNemar's, or sign test)?"""
    shares = [
        float(np.mean(hits[some])) if some.any() else np.nan for hits, some in (before, after)
    ]
    if np.isnan(shares).any():
        return None
    both = before[1] & after[1]
    gain = (after[0].astype(float) - before[0])[both]
    each = np.bincount(recording[both].astype(np.int64), gain) if both.any() else np.zeros(1)
    more, fewer = int(np.sum(each > 0.0)), int(np.sum(each < 0.0))
    certain = more + fewer > 0 and binomtest(more, more + fewer).pvalue < _CHANCE
    return Change(shares[0], shares[1], np.nan, np.nan, int(np.sign(more - fewer)) * certain)


def _error(before: Array, after: Array, recording: Array) -> Change:
    """The ratio of the medians, by resampling recordings."""
    groups = [np.flatnonzero(recording == one) for one in np.unique(recording)]
    rng = np.random.default_rng(0)
    drawn = (rng.integers(len(groups), size=len(groups)) for _ in range(_RESAMPLES))
    some = [np.concatenate([groups[k] for k in pick]) for pick in drawn]
    medians = [np.array([np.median(one[k]) for k in some]) for one in (before, after)]
    tiny = np.finfo(float).tiny
    ratios = (medians[1] + tiny) / (medians[0] + tiny)
    low, high = np.quantile(ratios, [0.5 * _CHANCE, 1.0 - 0.5 * _CHANCE])
    sign = int(high < 1.0 - _WORTH_A_LINE) - int(low > 1.0 + _WORTH_A_LINE)
    return Change(float(np.median(before)), float(np.median(after)), low, high, sign)


def _line(figures: Mapping[str, Change], every: bool) -> str:
    marks = {-1: " WORSE", 0: "", 1: " better"}
    parts = []
    for name, change in figures.items():
        if not (every or change.sign):
            continue
        if name in _SHARES:
            text = f"{100 * change.before:.0f} -> {100 * change.after:.0f} %"
        elif name == "ms":
            text = f"{change.before:.2f} -> {change.after:.2f}"
        else:
            text = f"{change.before:.3g} -> {change.after:.3g} "
            text += f"(x {change.low:.2f} to {change.high:.2f})"
        parts.append(f"{name} {text}{marks[change.sign]}")
    return "; ".join(parts)


def totals(judged: Mapping[str, Judged]) -> dict[str, dict[str, float]]:
    """Of each bench and of all: shares of all frames (%), medians, sharpness, ms."""
    found = {}
    for bench, those in _by_bench(judged).items():
        joined = _joined([judged[name] for name in those])
        row = {
            name: 100.0 * float(np.mean(hits[some])) if some.any() else np.nan
            for name, (hits, some) in _hits(joined).items()
        }
        some = joined.localized
        del row["not>5s"]
        row[">5s"] = 100.0 * float(np.mean(far_off(joined)[some])) if some.any() else np.nan
        for name, figure in _ERRORS.items():
            row[name] = quantile(joined.of(figure)[some], 0.5)
        for name in _SHARP:
            row[f"s_{name}"] = sharpness(joined.of(name)[some])
        row["ms"], row["ms_95"] = (quantile(joined.of("ms"), q) for q in (0.5, 0.95))
        found[bench] = row
    return found


def totals_line(label: str, row: Mapping[str, float] | None, width: int = 12) -> str:
    """One line of the table; without a row: the names of the columns."""
    sharp = (f"s_{name}" for name in _SHARP)
    names = ("localized", *_SHARES[1:-1], ">5s", *_ERRORS, *sharp, "ms", "ms_95")
    cells = (f"{name if row is None else f'{row[name]:.3g}':>10}" for name in names)
    return f"{label:{width}}{''.join(cells)}"


def changes_together(
    before: Mapping[str, Judged], after: Mapping[str, Judged],
    changes: Mapping[str, Mapping[str, Change]],
) -> dict[str, Change]:  # fmt: skip
    """Of conditions together: shares of all frames, and the mean ratio of the errors."""
    found = _shares(*(_joined([table[name] for name in changes]) for table in (before, after)))
    for name in _ERRORS:
        those = [each[name] for each in changes.values() if name in each]
        pairs = [(one.before, one.after) for one in those if one.before > 0.0 and one.after > 0.0]
        if len(pairs) > 1:
            logs = np.log([after / before for before, after in pairs])
            error = float(np.std(logs, ddof=1)) / np.sqrt(len(logs))
            wide = error * float(student.isf(0.5 * _CHANCE, len(logs) - 1))
            low, mean, high = np.exp(np.mean(logs) + wide * np.array([-1.0, 0.0, 1.0]))
            found[name] = Change(1.0, mean, low, high, int(high < 1.0) - int(low > 1.0))
    return found


def _by_bench(names: Iterable[str]) -> dict[str, list[str]]:
    """Conditions of each bench, and all of them."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(name.split("/")[0], []).append(name)
    return found | {"all": list(names)}


def _joined(those: Sequence[Judged]) -> Judged:
    """Conditions as one; a recording is one of its condition."""
    parts, first = [], 0
    for one in those:
        figures = one.figures.copy()
        figures[:, FIGURES.index("recording")] += first
        first += int(one.of("recording").max()) + 1
        parts.append(figures)
    return Judged(np.concatenate(parts), [reason for one in those for reason in one.reasons])


def _write_totals(
    before: Mapping[str, Judged], after: Mapping[str, Judged],
    changes: Mapping[str, Mapping[str, Change]],
) -> None:  # fmt: skip
    """Two rows for each bench, and what is certain of all its conditions together."""
    both = [totals({name: table[name] for name in changes}) for table in (before, after)]
    sys.stdout.write(f"\n{totals_line('', None)}\n")
    for bench, names in _by_bench(changes).items():
        for label, table in zip((bench, "  after"), both, strict=True):
            sys.stdout.write(f"{totals_line(label, table[bench])}\n")
        together = changes_together(before, after, {name: changes[name] for name in names})
        sys.stdout.write(f"{'':15}  {_line(together, False) or 'nothing certain'}\n")
