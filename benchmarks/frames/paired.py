# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.frames paired``: one row of figures, beside another version's.

All versions see the same frames (:mod:`.paired_set`). Errors are compared on frames that both
localize, as geometric means over conditions of ratios of medians. Differences below 0.5 % of
regions and 3 % of errors are noise. ``paired without NAME`` switches a part of the estimator off
(:mod:`.switches`) and prints its row of a table of ablations.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import tempfile
import time
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks.experiments.results import Table
from benchmarks.frames import paired_set
from benchmarks.frames.compared import read, totals, write
from benchmarks.frames.conditions import BENCHES
from benchmarks.frames.judged import Judged, far_off
from benchmarks.frames.paired_set import OTHERS, SPOILT
from benchmarks.frames.switches import SWITCHES, switched_off

T = TypeVar("T")

_ROOT = Path(__file__).parents[2]
# Medians of fewer frames that both localize say little.
_FEWEST = 5
_RIGHT = 1.5  # deg, of a pose that nobody would call wrong
_REAL = ("boards", "phone")

_VIBRATION, _PLANES = ("sine", "bands", "noise", "impacts"), ("planes", "gyro", "locks")
_ALL = (*BENCHES, OTHERS)
GROUPS: dict[str, Container[str]] = {
    "all": _ALL,
    "vibration": _VIBRATION,
    "small planes": _PLANES,
    "neither": set(_ALL) - {*_VIBRATION, *_PLANES},
    "no bench has": (OTHERS,),
}
"""Benches that stand in one line."""
_HEADS = ("frames", "localized", "poses in", "twists in", "beyond 5")
_RATIOS = {"deg x": "deg", "mm x": "mm", "deg/s x": "deg/s", "CPU x": "ms"}


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One version on the paired set."""

    seed: int
    judged: Mapping[str, Judged]  # by bench/condition
    real: Mapping[str, float]  # of boards and phone

    def save(self, file: Path) -> None:
        """Keep all frames, for ``compare`` of benchmarks.frames, too."""
        names, values = list(self.real), list(self.real.values())
        write(file, self.judged, seed=self.seed, real=names, values=values)

    @classmethod
    def load(cls, file: Path) -> Result:
        """Raises ``OSError`` without the file, ``KeyError`` for one without boards and phone."""
        with np.load(file.with_suffix(".npz")) as kept:
            real = dict(zip(kept["real"].tolist(), kept["values"].tolist(), strict=True))
            seed = int(kept["seed"])
        return cls(seed, read(file), real)

    def on(self, other: Result) -> Result:
        """The same on another's conditions; raises ``ValueError`` if it has not seen its frames."""
        if self.seed != other.seed:
            raise ValueError(f"its frames are of --seed {self.seed}, these of {other.seed}")
        for name, one in other.judged.items():
            own = self.judged.get(name)
            if own is None or not np.array_equal(own.of("recording"), one.of("recording")):
                raise ValueError(f"the frames of {name} are others there, or missing")
        return Result(self.seed, {name: self.judged[name] for name in other.judged}, self.real)

    def of(self, benches: Container[str]) -> dict[str, Judged]:
        """Those of some benches."""
        return {name: one for name, one in self.judged.items() if name.split("/")[0] in benches}


def measured(options: argparse.Namespace, *lacking: tuple[str, ...]) -> list[Result]:
    """The version that Python finds, without some parts each; condition by condition in turns, so
    that times are of the same minute.
    """
    judged = _in_turns(lambda: paired_set.judged(options.seed, options.only), lacking)
    real, only = [dict[str, float]() for _ in lacking], options.only or _REAL
    if "boards" in only:
        with tempfile.TemporaryDirectory() as folder:
            cache = options.cache or Path(folder)
            real = _in_turns(lambda: paired_set.boards(options.boards, cache), lacking)
    if "phone" in only:
        folder_of_phone = options.phone or paired_set.phone_folder(_ROOT)
        if folder_of_phone is None:
            sys.stderr.write("the phone is left out: no phone_gyro is here; give --phone FOLDER\n")
        else:
            phones = _in_turns(lambda: paired_set.phone(folder_of_phone), lacking)
            real = [one | other for one, other in zip(real, phones, strict=True)]
    return [Result(options.seed, *each) for each in zip(judged, real, strict=True)]


def _in_turns(
    stream: Callable[[], Iterator[tuple[str, T]]], lacking: Sequence[tuple[str, ...]]
) -> list[dict[str, T]]:
    """What a stream says by name, without some parts each."""
    streams, found = [stream() for _ in lacking], [dict[str, T]() for _ in lacking]
    while True:
        for parts, one, into in zip(lacking, streams, found, strict=True):
            with switched_off(*parts):
                said = next(one, None)
            if said is None:
                return found
            into[said[0]] = said[1]


def line(versions: Sequence[Mapping[str, Judged]]) -> tuple[str, ...]:
    """Cells below ``_HEADS``, and of two versions those below ``_RATIOS``."""
    frames = sum(len(one.reasons) for one in versions[-1].values())
    rows = [totals(judged)["all"] for judged in versions]
    shares = [[f"{row[name]:.1f}" for row in rows] for name in ("localized", "pose@m", "twist@m")]
    beyond = [str(sum(far_off(one).sum() for one in judged.values())) for judged in versions]
    found = ratios(versions[0], versions[-1]) if len(versions) > 1 else {}
    return (
        str(frames), *map(" -> ".join, (*shares, beyond)),
        *(f"{found[name]:.2f}" for name in _RATIOS.values() if found),
    )  # fmt: skip


def ratios(before: Mapping[str, Judged], after: Mapping[str, Judged]) -> dict[str, float]:
    """Geometric means over conditions of ratios of medians: of errors, and of times (``ms``)."""
    logs: dict[str, list[float]] = {name: [] for name in _RATIOS.values()}
    for one, other in ((before[name], after[name]) for name in after):
        both = one.localized & other.localized
        for name, of in logs.items():
            some = np.ones_like(both) if name == "ms" else both
            if np.count_nonzero(some) < _FEWEST:
                continue
            medians = [float(np.median(each.of(name)[some])) for each in (one, other)]
            if np.isfinite(medians).all() and min(medians) > 0.0:
                of.append(math.log(medians[1] / medians[0]))
    return {name: math.exp(np.mean(of)) if of else math.nan for name, of in logs.items()}


def outcome(those: Mapping[str, Judged]) -> str:
    """What became of spoilt frames: published, right and far off."""
    published = sum(int(one.localized.sum()) for one in those.values())
    right = sum(int(np.sum(one.of("deg") < _RIGHT)) for one in those.values())
    beyond = sum(int(far_off(one).sum()) for one in those.values())
    return f"{published}, {right}, {beyond}"


def report(versions: Sequence[Result]) -> str:
    """All figures of the last version, beside those of the one before it."""
    columns = ("before", "after") if len(versions) > 1 else ("now",)
    parts, last = [], versions[-1]
    groups = [(group, [one.of(of) for one in versions]) for group, of in GROUPS.items()]
    rows = [(group, *line(those)) for group, those in groups if those[-1]]
    if rows:
        heads = (*_HEADS, *_RATIOS) if len(versions) > 1 else _HEADS
        parts.append(Table(("", *heads), rows).text())
    spoilt = [
        (kind, str(sum(len(each.reasons) for each in last.of((kind,)).values())),
         *(outcome(one.of((kind,))) for one in versions))
        for kind in SPOILT if last.of((kind,))
    ]  # fmt: skip
    if spoilt:
        heads = (f"published, right to {_RIGHT} deg, beyond 5", "frames", *columns)
        parts.append(Table(heads, spoilt).text())
    real: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for method, names in itertools.groupby(last.real, lambda name: name.rpartition("/")[0]):
        figures = [name.removeprefix(f"{method}/") for name in names]
        cells = [
            " -> ".join(f"{one.real.get(f'{method}/{name}', math.nan):.3g}" for one in versions)
            for name in figures
        ]
        real.setdefault(tuple(figures), []).append((method, *cells))
    parts += [Table(("", *figures), lines).text() for figures, lines in real.items()]
    return "\n\n".join(parts)


def ablation(name: str, versions: Sequence[Result]) -> str:
    """Head and row of the table of ablations: what a part buys."""
    last = versions[-1]
    kinds = [kind for kind in SPOILT if last.of((kind,))]
    phone = [of for of in last.real if of.startswith("phone") and of.endswith("twist")]
    heads = ("without", *_HEADS, *_RATIOS, *kinds, *phone)
    cells = [name, *line([one.of(_ALL) for one in versions])]
    cells += [" -> ".join(outcome(one.of((kind,))) for one in versions) for kind in kinds]
    cells += [" -> ".join(f"{one.real.get(of, math.nan):.2f}" for one in versions) for of in phone]
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, cells))


def paired(options: argparse.Namespace) -> int:
    """The command."""
    words = options.words
    if words and (len(words) != 2 or words[0] != "without" or words[1] not in SWITCHES):
        sys.stderr.write(f"expected without NAME, with NAME one of {', '.join(SWITCHES)}\n")
        return 2
    versions: list[Result] = []
    try:
        if options.against is not None:
            versions.append(Result.load(options.against))
        lacking = [tuple(words[1:])]
        if words and options.against is None:
            lacking.insert(0, ())
        start = time.process_time()
        *today, result = measured(options, *lacking)
        sys.stderr.write(f"{time.process_time() - start:.0f} s of CPU\n")
        if options.save is not None:
            result.save(options.save)
        versions = [*(one.on(result) for one in (*versions, *today)), result]
    except (OSError, KeyError, ValueError) as error:
        sys.stderr.write(f"{options.against or options.save}: {error}\n")
        return 2
    print(report(versions))
    if words and result.of(_ALL):
        print("", ablation(words[1], versions), sep="\n")
    return 0


def add_to(parser: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    parser.description = __doc__
    parser.add_argument("words", nargs="*", metavar="without NAME",
                        help=f"a part that is switched off: {', '.join(SWITCHES)}")  # fmt: skip
    parser.add_argument("--save", type=Path, metavar="FILE.npz", help="keep all frames")
    parser.add_argument("--against", type=Path, metavar="FILE.npz", help="saved by another version")
    parser.add_argument("--only", nargs="+", default=(), metavar="BENCH",
                        choices=(*_ALL, *SPOILT, *_REAL),
                        help=f"benches, or {', '.join((OTHERS, *SPOILT, *_REAL))}")  # fmt: skip
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="(1); others are fresh")
    parser.add_argument("--phone", type=Path, metavar="FOLDER", help="with rec and gyroscope.txt")
    parser.add_argument("--boards", type=Path, metavar="FOLDER",
                        help="videos of boards besides, as benchmarks.real takes them")  # fmt: skip
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="their corners, calibrations")
    parser.set_defaults(command=paired)
