# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.signals``: commands that get signals at random moments.

Each ends as the signal says or has finished; nothing stays under a final name that is not whole,
and nothing beside it.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from typing import NamedTuple

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PROGRAM = (sys.executable, "-m", "rs_localizer")
# Commands by name, and their inputs; each writes to out, or to files that begin so.
_FLIGHT = "simulate flight --duration 4 --points 60".split()
_FILM = (
    "simulate film --images --walls marked_room --duration 0.2 "
    "--angular-velocity 0 0.5 0 --linear-velocity 2.5 0 0"
).split()
COMMANDS = {
    "replay": "replay flight --params flight/parameters.yaml --out out",
    "detect": "detect film --map film/marker_map.yaml --out out",
    "simulate": "simulate out --duration 4",
    "markers": "markers make out --grid 6x4",
    "calibrate": "calibrate flight --out out.yaml",
    "map build": "map build film --markers film/marker_map.yaml --params film/parameters.yaml "
    "--out out --max-keypoints 500 --threads 1",
}


class Ended(NamedTuple):
    """How a command ended after a signal."""

    command: str
    number: int  # of the signal
    delay: float  # s after the start
    code: int
    fault: str  # empty: as it should


def campaign(count: int, seed: int, commands: Sequence[str] = tuple(COMMANDS)) -> Iterator[Ended]:
    """Start the commands in turn, each with a signal at a random moment of its time."""
    random = Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        inputs.mkdir()
        for words in (_FLIGHT, _FILM):
            subprocess.run([*_PROGRAM, *words], cwd=inputs, check=True, capture_output=True)
        for name in commands:  # compiles
            _run(name, Path(folder), None, 0.0)
        normal = {name: _run(name, Path(folder), None, 0.0) for name in commands}
        for k in range(count):
            name = commands[k % len(commands)]
            number, delay = random.choice(_SIGNALS), random.uniform(0.0, normal[name].seconds)
            result = _run(name, Path(folder), number, delay)
            fault = _fault(result, normal[name], number)
            yield Ended(name, number, delay, result.code, fault)


class _Result(NamedTuple):
    code: int
    seconds: float
    errors: str
    files: tuple[str, ...]  # that are there now


def _run(name: str, folder: Path, number: int | None, delay: float) -> _Result:
    work = folder / "work"
    shutil.copytree(folder / "inputs", work)
    try:
        before = set(work.rglob("*"))
        start = time.monotonic()
        process = subprocess.Popen(
            [*_PROGRAM, *COMMANDS[name].split()], cwd=work,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        if number is not None:
            time.sleep(delay)
            process.send_signal(number)
        _, errors = process.communicate(timeout=3600)  # of a busy machine
        files = sorted(str(path.relative_to(work)) for path in set(work.rglob("*")) - before)
        return _Result(process.returncode, time.monotonic() - start, errors, tuple(files))
    finally:
        shutil.rmtree(work)


def _fault(result: _Result, normal: _Result, number: int) -> str:
    # Before Python has taken it in hand, a signal ends the process by itself.
    if result.code not in (normal.code, 128 + number, -number):
        return f"exit code {result.code}: {result.errors[-500:]}"
    if result.files not in ((), normal.files):
        return f"left {', '.join(result.files)}"
    if result.code == normal.code and result.files != normal.files:
        return "ended well without a result"
    if "Traceback" in result.errors and result.code != -number:
        return result.errors[-500:]
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.signals", description=__doc__)
    parser.add_argument("--count", type=int, default=1000, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", choices=COMMANDS, metavar="NAME", help="this one only")
    options = parser.parse_args()
    codes: Counter[tuple[str, int]] = Counter()
    faults = 0
    chosen = tuple(COMMANDS) if options.command is None else (options.command,)
    for ended in campaign(options.count, options.seed, chosen):
        codes[ended.command, ended.code] += 1
        if ended.fault:
            faults += 1
            sys.stdout.write(f"{ended}\n")
            sys.stdout.flush()
    for (command, code), number in sorted(codes.items()):
        sys.stdout.write(f"{command:10} exit code {code:4} {number:5}\n")
    sys.stdout.write(f"{faults} faults of {options.count} signals\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
