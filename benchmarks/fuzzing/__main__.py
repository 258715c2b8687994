# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.fuzzing``: exit code 1 when something fails."""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import sys
import tempfile
import warnings
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from tqdm import tqdm

from benchmarks.fuzzing.campaign import run
from benchmarks.fuzzing.targets import targets


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fuzzing",
        description="Wrong input for everything that reads messages, files and settings.",
    )
    parser.add_argument("--executions", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", metavar="NAME", help="this one only")
    parser.add_argument(
        "--memory", type=int, default=1024, metavar="MB", help="that an input may take"
    )
    options = parser.parse_args()
    warnings.simplefilter("error")
    # In memory where there is such a place: a million small files are no work for a disk.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        chosen = targets(Path(folder))
        if options.target is not None:
            chosen = {options.target: chosen[options.target]}
        _limit_memory(options.memory)
        reports = run(chosen, options.executions, options.seed)
        with _silent_libraries() as stderr:
            bar = tqdm(reports, total=options.executions, unit="input", file=stderr, disable=None)
            (report,) = deque(bar, maxlen=1)
    sys.stdout.write(f"{report.text()}\n")
    return 1 if report.failures else 0


@contextlib.contextmanager
def _silent_libraries() -> Iterator[TextIO]:
    """Discard what libpng and libjpeg say of every picture; the terminal, for others."""
    with os.fdopen(os.dup(2), "w") as stderr, Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        try:
            yield stderr
        finally:
            os.dup2(stderr.fileno(), 2)


def _limit_memory(megabytes: int) -> None:
    """What asks for more gets a MemoryError, which no reader may raise."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + megabytes * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


if __name__ == "__main__":
    sys.exit(main())
