# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.demo``: the medians of ``rs_localizer demo``, ours beside P3P's.

With ``--pictures docs`` its pictures become those of README, so that they and the figures are of
one run.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

from benchmarks.experiments.results import Table, rounded

_TITLE = re.compile(r"(.+), (\d+) frames  .*median")
_ROW = re.compile(r"(.+), (\w+) +(\d+) +([\d.]+)")


PICTURES = {"flight_errors.png": "errors.png", "cube.gif": "cube.gif"}
"""Of the demo, and their names in docs."""


def main() -> int:
    """Run the demo and print its table; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.demo", description=__doc__)
    parser.add_argument("--pictures", type=Path, help="folder for its pictures")
    pictures = parser.parse_args().pictures
    with tempfile.TemporaryDirectory() as out:
        words = ["-m", "rs_localizer", "demo", "--json", "--out", out]
        demo = subprocess.run([sys.executable, *words], check=True, stdout=subprocess.PIPE)
        if pictures is not None:
            for name, there in PICTURES.items():
                shutil.copyfile(Path(out) / name, pictures / there)
    print(summary(json.loads(demo.stdout)["text"]))
    return 0


def summary(lines: list[str]) -> str:
    """Table of the medians that the demo has printed, and what it says of cube and node."""
    rows: dict[tuple[str, str], dict[str, str]] = {}
    said, recording, frames = [], "", 0
    for line in lines:
        if title := _TITLE.match(line):
            recording, frames = title[1], int(title[2])
        elif row := _ROW.match(line):
            quantity, solver, count, middle = row.groups()
            if quantity == "inliers":
                continue
            localized = rows.setdefault((f"{recording}, {frames} frames", "localized"), {})
            localized[solver] = f"{100.0 * int(count) / frames:.1f} %"
            scale, unit = (1e3, "mm") if quantity == "position (m)" else (1.0, "m")
            name = quantity.replace("(m)", f"({unit})")
            rows.setdefault((f"{recording}, {frames} frames", name), {})[solver] = rounded(
                scale * float(middle)
            )
        elif "farthest corner" in line or "live node has answered" in line:
            said += textwrap.wrap(line, 100)
    solvers = list(dict.fromkeys(solver for row in rows.values() for solver in row))
    cells = [
        (f"{of}: {name}", *(row.get(solver, "") for solver in solvers))
        for (of, name), row in rows.items()
    ]
    return "\n".join([Table(("medians", *solvers), cells).text(), *said])


if __name__ == "__main__":
    sys.exit(main())
