# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Stop the node at random moments: ``python -m benchmarks.load.signals --times 100``.

Each time a node is started, with kernels in the cache or without, while a camera publishes; after a
random time it gets SIGINT or SIGTERM, and has to end with exit code 0 within two seconds. The time
counts from the moment when the node takes its signals in hand, its first statement: what comes
before is the start of Python itself, which a signal ends in Python's own way.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.load.frames import READOUT_TIME, simulated
from benchmarks.load.measuring import NODE_PROGRAM
from rs_localizer.cli.options import integer, number

_TIME_LIMIT = 2.0  # s
_PATIENCE = 60.0  # s, before it is killed
_RATE = 100.0  # Hz
_EMPTY_CACHE = 0.3  # share of the starts that have to compile


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load.signals", description=__doc__)
    parser.add_argument("--times", type=integer(1), default=100)
    parser.add_argument("--longest", type=number(0.0), default=6.0, help="s until the signal")
    parser.add_argument("--seed", type=integer(0), default=0)
    args = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rng = random.Random(args.seed)
    namespace = f"/load_{os.getpid()}"
    slowest, faults = 0.0, 0
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        camera = _camera(namespace, directory, args.times * (args.longest + 10.0))
        try:
            for index in tqdm(range(args.times), unit="node", disable=None):
                number_of_signal = rng.choice((signal.SIGINT, signal.SIGTERM))
                delay = rng.uniform(0.0, args.longest)
                cache = directory / f"cache{index}" if rng.random() < _EMPTY_CACHE else None
                log = directory / "node.log"
                code, seconds = _stop(namespace, number_of_signal, delay, cache, log)
                slowest = max(slowest, seconds)
                if code != 0 or seconds > _TIME_LIMIT:
                    faults += 1
                    print(
                        f"{number_of_signal.name} after {delay:.2f} s, "
                        f"{'cached' if cache is None else 'compiling'}: exit code {code} after "
                        f"{seconds:.2f} s\n{log.read_text()[-2000:]}"
                    )
        finally:
            camera.kill()
            camera.wait()
    print(
        f"{args.times} signals: {args.times - faults} times exit code 0 within {_TIME_LIMIT:g} s; "
        f"the slowest end took {slowest:.2f} s"
    )
    return 1 if faults else 0


def _camera(namespace: str, directory: Path, seconds: float) -> subprocess.Popen[bytes]:
    """A process that publishes frames for so long, once the first node listens."""
    frames_file, sent_file = directory / "frames.npz", directory / "sent"
    simulated(points=500, outliers=0.3, rate=_RATE).save(frames_file)
    np.memmap(sent_file, np.float64, mode="w+", shape=round(seconds * _RATE))
    arguments = (namespace, str(frames_file), str(sent_file))
    module = "benchmarks.load.camera"
    return subprocess.Popen([sys.executable, "-m", module, *arguments])


def _stop(
    namespace: str, number: signal.Signals, delay: float, cache: Path | None, log: Path
) -> tuple[int, float]:
    """Exit code, and the seconds from the signal to the end, of one node."""
    environment = dict(os.environ)
    if cache is not None:
        environment["XDG_CACHE_HOME"] = str(cache)
    settings = ("-r", f"__ns:={namespace}", "-p", f"readout_time:={READOUT_TIME}")
    with log.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-c", NODE_PROGRAM, "--ros-args", *settings],
            stdout=file,
            stderr=file,
            env=environment,
        )
    while process.poll() is None and not _takes_signals(process.pid):
        time.sleep(0.001)
    time.sleep(delay)
    sent = time.monotonic()
    process.send_signal(number)
    try:
        return process.wait(_PATIENCE), time.monotonic() - sent
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait(), time.monotonic() - sent


def _takes_signals(pid: int) -> bool:
    """Whether a process has a handler of SIGTERM, which Python itself has not."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("SigCgt:"):
            return bool(int(line.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
    return False


if __name__ == "__main__":
    sys.exit(main())
