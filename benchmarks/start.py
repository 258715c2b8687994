# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.start``: what a start of the node costs, beside a plain rclpy node.

Resident memory and time until the node is active, with an empty cache of kernels and a warm one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

_PLAIN = """
import rclpy, sys
rclpy.init()
node = rclpy.create_node("plain")
print("active with", file=sys.stderr, flush=True)
rclpy.spin(node)
"""
_NODE = "from rs_localizer.ros.main import main; main()"
_TIMEOUT = 1200.0  # s
_SETTLED = 3.0  # s: then diagnostics and timers have run


class Start(NamedTuple):
    """What a start cost."""

    seconds: float  # until active
    work: float  # s of the processor, of the children too
    resident: float  # MB when active
    peak: float  # MB of the process itself


def measure(program: str, cache: Path) -> Start:
    """Start a program, wait until it says that it is active, and end it."""
    environment = os.environ | {
        "XDG_CACHE_HOME": str(cache),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1),
    }
    before, began = os.times(), time.monotonic()
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen([sys.executable, "-c", program], env=environment, stderr=log)
        try:
            while "active with" not in (log.seek(0), log.read())[1]:
                if process.poll() is not None or time.monotonic() - began > _TIMEOUT:
                    raise RuntimeError((log.seek(0), log.read())[1])
                time.sleep(0.05)
            seconds = time.monotonic() - began
            time.sleep(_SETTLED)
            status = Path(f"/proc/{process.pid}/status").read_text().splitlines()
        finally:
            process.terminate()
            process.wait()
    memory = {line.split(":")[0]: float(line.split()[1]) / 1e3 for line in status if "kB" in line}
    after = os.times()
    work = (after.children_user - before.children_user) + (
        after.children_system - before.children_system
    )
    return Start(seconds, work, memory["VmRSS"], memory["VmHWM"])


def main() -> int:
    argparse.ArgumentParser(prog="python -m benchmarks.start", description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = (("plain rclpy node", _PLAIN), ("cold", _NODE), ("warm", _NODE), ("warm", _NODE))
        print(f"{'':18}{'s':>8}{'s of CPU':>10}{'RSS, MB':>9}{'peak, MB':>10}")
        for name, program in rows:
            it = measure(program, Path(folder))
            print(
                f"{name:18}{it.seconds:8.1f}{it.work:10.1f}{it.resident:9.0f}{it.peak:10.0f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
