# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.frames paired``: one row of figures, beside another version's.

The same frames for all (:mod:`.paired_set`): errors are compared on frames that both localize, as
geometric means over conditions of ratios of medians. Differences below 0.5 % of regions and 3 % of
errors are noise. ``paired without NAME`` switches a part of the estimator off (:mod:`.switches`).
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import rs_localizer as rsl
from benchmarks.experiments.results import Table
from benchmarks.frames import paired_set
from benchmarks.frames.compared import read, write
from benchmarks.frames.judged import REGION, Judged, camera_of, far_off
from benchmarks.frames.switches import SWITCHES, switched_off

# Conditions of fewer frames that both localize have no medians.
_FEWEST = 5
_RIGHT = 1.5  # deg, of a pose beside a second body
_ROOT = Path(__file__).parents[2]
_VIBRATION, _PLANES = ("sine", "bands", "noise", "impacts"), ("planes", "gyro", "locks")

Conditions = Mapping[str, Judged]

GROUPS: dict[str, Callable[[str], bool]] = {
    "all": lambda bench: bench not in paired_set.SPOILT,
    "vibration": lambda bench: bench in _VIBRATION,
    "small planes": lambda bench: bench in _PLANES,
    "neither": lambda bench: bench not in (*_VIBRATION, *_PLANES, *paired_set.SPOILT),
    "no bench has": lambda bench: bench == "others",
}
"""Conditions that stand in one line, by their benches."""


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One version on the paired set."""

    judged: Conditions
    real: Mapping[str, float]  # boards and phone

    def save(self, file: Path) -> None:
        """As ``run`` of benchmarks.frames does, so that ``compare`` reads it, too."""
        write(file, self.judged, real=list(self.real), values=list(self.real.values()))

    @classmethod
    def load(cls, file: Path) -> Result:
        """Raises ``OSError`` without the file, ``KeyError`` for one of ``run``."""
        with np.load(file.with_suffix(".npz")) as kept:
            names, values = kept["real"].tolist(), kept["values"].tolist()
        return cls(read(file), dict(zip(names, values, strict=True)))


def measured(options: argparse.Namespace) -> Result:
    """The version that Python finds."""
    rsl.Localizer(camera_of(next(paired_set.benches()), 0)).warm_up()
    only = options.only
    judged = dict(paired_set.judged(options.seed, only))
    real: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as cache:
        if not only or "boards" in only:
            real |= dict(paired_set.boards(options.boards, options.cache or Path(cache)))
    folder = options.phone or paired_set.phone_folder(_ROOT)
    if folder is None:
        sys.stderr.write("the phone is left out: no phone_gyro is found; give --phone FOLDER\n")
    elif not only or "phone" in only:
        real |= dict(paired_set.phone(folder))
    return Result(judged, real)


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of some conditions together."""

    frames: int
    localized: float  # %
    poses: float  # %, inside 95 % regions, of those localized
    twists: float  # %
    beyond: int  # five sigma

    @classmethod
    def of(cls, those: Iterable[Judged]) -> Row:
        """Of all their frames alike."""
        shown = list(those)

        def joined(name: str) -> NDArray[np.float64]:
            return np.concatenate([one.of(name)[one.localized] for one in shown])

        twists = joined("twist")
        inside = REGION
        return cls(
            sum(len(one.reasons) for one in shown),
            _percent(np.concatenate([one.localized for one in shown])),
            _percent(joined("pose") < inside),
            _percent(twists[~np.isnan(twists)] < inside),
            int(sum(far_off(one).sum() for one in shown)),
        )


def _percent(hits: NDArray[np.bool_]) -> float:
    return 100.0 * float(np.mean(hits)) if len(hits) else math.nan


def ratios(before: Iterable[Judged], after: Iterable[Judged]) -> dict[str, float]:
    """Geometric means over conditions of ratios of medians, of frames that both localize.

    Of errors (deg, mm, deg/s) and of CPU time (ms), of which all frames count.
    """
    logs: dict[str, list[float]] = {name: [] for name in ("deg", "mm", "deg/s", "ms")}
    for one, other in zip(before, after, strict=True):
        both = one.localized & other.localized
        for name, of in logs.items():
            some = np.ones_like(both) if name == "ms" else both
            medians = [np.median(each.of(name)[some]) for each in (one, other) if some.any()]
            if some.sum() >= _FEWEST and np.isfinite(medians).all() and min(medians) > 0.0:
                of.append(math.log(medians[1] / medians[0]))
    return {name: math.exp(np.mean(of)) if of else math.nan for name, of in logs.items()}


def chosen(judged: Conditions, of: Callable[[str], bool]) -> dict[str, Judged]:
    """Those of some benches."""
    return {name: one for name, one in judged.items() if of(name.split("/")[0])}


def spoilt(result: Result) -> dict[str, str]:
    """What became of frames that should have no pose, or hardly have one."""
    said = {}
    for kind in paired_set.SPOILT:
        those = list(chosen(result.judged, lambda bench, kind=kind: bench == kind).values())
        if those:
            published = sum(int(one.localized.sum()) for one in those)
            beyond = sum(int(far_off(one).sum()) for one in those)
            right = sum(int(np.sum(one.of("deg") < _RIGHT)) for one in those)
            frames = sum(len(one.reasons) for one in those)
            said[kind] = f"{published}, {right}, {beyond} of {frames}"
    return said


def table(result: Result, before: Result | None) -> Table:
    """A line for each group; of two versions ``before -> after``, and ratios of errors."""
    heads = ["", "frames", "localized", "poses in", "twists in", "beyond 5"]
    if before is not None:
        heads += ["deg x", "mm x", "deg/s x", "CPU x"]
    lines = []
    for group, of in GROUPS.items():
        both = [chosen(one.judged, of) for one in (before, result) if one is not None]
        if not both[-1]:
            continue
        rows = [Row.of(those.values()) for those in both]
        cells = [group, str(rows[-1].frames)]
        for name in ("localized", "poses", "twists", "beyond"):
            cells.append(_arrow([_short(getattr(row, name)) for row in rows]))
        if before is not None:
            of_errors = ratios(both[0].values(), both[1].values())
            cells += [f"{ratio:.2f}" for ratio in of_errors.values()]
        lines.append(tuple(cells))
    return Table(tuple(heads), lines)


def ablation(name: str, result: Result, before: Result) -> str:
    """The line of the table of ablations: what a part buys."""
    of = GROUPS["all"]
    both = [chosen(one.judged, of) for one in (before, result)]
    rows = [Row.of(those.values()) for those in both]
    errors = ratios(both[0].values(), both[1].values())
    lens = [spoilt(one).get("lens", "-").split(",")[0] for one in (before, result)]
    cells = [
        name,
        f"{_arrow([_short(row.localized) for row in rows])} (n {rows[0].frames})",
        ", ".join(f"{errors[each]:.2f}" for each in ("deg", "mm", "deg/s")),
        *(_arrow([_short(getattr(row, each)) for row in rows]) for each in ("poses", "twists")),
        _arrow([str(row.beyond) for row in rows]),
        _arrow(lens),
        f"{errors['ms']:.2f}",
    ]
    head = "mechanism off | localized % | deg, mm, twist x | pose in 95 % | twist in 95 % | >5s"
    return f"| {head} | lenses published | CPU x |\n| {' | '.join(cells)} |"


def _arrow(texts: list[str]) -> str:
    return " -> ".join(texts)


def _short(value: float) -> str:
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def report(result: Result, before: Result | None) -> str:
    """All figures, beside those of another version."""
    versions = [one for one in (before, result) if one is not None]
    lines = [table(result, before).text()] if chosen(result.judged, GROUPS["all"]) else []
    lost = [spoilt(one) for one in versions]
    lines += [
        f"{kind}: published, right to {_RIGHT} deg, beyond 5: "
        f"{_arrow([one.get(kind, '-') for one in lost])}"
        for kind in lost[-1]
    ]
    shown = [(name, *(f"{one.real.get(name, math.nan):.3f}" for one in versions))
             for name in result.real]  # fmt: skip
    if shown:
        heads = ("", "before", "after")[: 1 + len(versions)]
        lines.append(Table(heads, shown).text())
    return "\n".join(lines)


def paired(options: argparse.Namespace) -> int:
    """The command."""
    before = None
    if options.against is not None:
        try:
            before = Result.load(options.against)
        except (OSError, KeyError) as error:
            sys.stderr.write(f"{options.against} holds no paired set: {error}\n")
            return 2
    if options.part is not None and before is None:
        before = measured(options)
    start = time.process_time()
    if options.part is None:
        result = measured(options)
    else:
        with switched_off(options.part[1]):
            result = measured(options)
    taken = time.process_time() - start
    if options.save is not None:
        result.save(options.save)
    if before is not None:
        before = _those_of(before, result)
        if before is None:
            sys.stderr.write("frames differ: the other version has another set or seed\n")
            return 2
    sys.stdout.write(f"{report(result, before)}\n")
    if options.part is not None and before is not None and chosen(before.judged, GROUPS["all"]):
        sys.stdout.write(f"{ablation(options.part[1], result, before)}\n")
    sys.stderr.write(f"{taken:.0f} s of CPU\n")
    return 0


def _those_of(before: Result, after: Result) -> Result | None:
    """The other version on the conditions of this one; None where frames differ."""
    names = list(after.judged)
    if any(
        name not in before.judged or len(before.judged[name].reasons) != len(one.reasons)
        for name, one in after.judged.items()
    ):
        return None
    return Result({name: before.judged[name] for name in names}, before.real)


def add_to(parser: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    parser.description = __doc__
    parser.add_argument("part", nargs="*", metavar="without NAME", action=_Without,
                        help=f"{', '.join(SWITCHES)}: switched off, beside today's")  # fmt: skip
    parser.add_argument("--save", type=Path, metavar="FILE.npz", help="keep all frames")
    parser.add_argument("--against", type=Path, metavar="FILE.npz", help="saved by another version")
    parser.add_argument("--only", nargs="+", default=(), metavar="BENCH",
                        help="conditions of these benches, boards, phone (all)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="(1); others are fresh")
    parser.add_argument("--phone", type=Path, metavar="FOLDER", help="with rec and gyroscope.txt")
    parser.add_argument("--boards", type=Path, metavar="FOLDER",
                        help="videos of boards besides, as benchmarks.real takes them")  # fmt: skip
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="their corners, calibrations")
    parser.set_defaults(command=paired)


class _Without(argparse.Action):
    """``without NAME``, or nothing."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: object,
        option_string: str | None = None,
    ) -> None:  # fmt: skip
        del option_string
        words = list(values) if isinstance(values, list) else []
        if words and (len(words) != 2 or words[0] != "without" or words[1] not in SWITCHES):
            parser.error(f"expected without NAME, NAME one of {', '.join(SWITCHES)}")
        setattr(namespace, self.dest, tuple(words) or None)
