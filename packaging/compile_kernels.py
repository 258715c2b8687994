# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiles the kernels for kinds of CPUs into the package, for a wheel whose users do not wait.

    python packaging/compile_kernels.py [--cpu x86-64-v3] ... [--solver r6p_vcwt] ...

Run it in an environment that has the libraries of the package, in the versions for which the wheel
is: the code is Python's (3.11 to 3.14) and Numba's (to the last digit), and setup.py then says so.
The package itself is taken from this tree. Without --cpu: for all kinds that this machine can be.
With --solver: only what nodes with it need; all else is compiled by who uses it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "rs_localizer"
# What the kernels are for: setup.py requires it of those who install the wheel.
_ABOUT = """
import json, sys
import numba
from numba.core.registry import cpu_target
from rs_localizer.core.simd import shipped
features = cpu_target.target_context.codegen().magic_tuple()[2]
python = "{}.{}".format(*sys.version_info)
print(json.dumps({"python": python, "numba": numba.__version__, "cpus": shipped.levels(features)}))
"""


def run(arguments: list[str], **environment: str) -> str:
    """What a Python that imports this tree prints; RuntimeError when it fails."""
    cleared = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=cleared | {"PYTHONPATH": str(ROOT)} | environment,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(arguments[:3])} ended with {done.returncode}")
    return done.stdout


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cpu", action="append", help="x86-64-v3, x86-64-v4; may be repeated")
    parser.add_argument("--solver", action="append", default=[], help="as of rs_localizer warm")
    arguments = parser.parse_args()
    given = arguments.cpu
    solvers = [word for name in arguments.solver for word in ("--solver", name)]
    about = json.loads(run(["-c", _ABOUT]))
    wanted = given or about["cpus"]
    if not wanted or not set(wanted) <= set(about["cpus"]):
        # Compiling runs every kernel once.
        can = " and ".join(about["cpus"]) or "none of them"
        print(f"compile_kernels: this machine can compile for {can}", file=sys.stderr)
        return 1
    folder = PACKAGE / "compiled"
    shutil.rmtree(folder, ignore_errors=True)
    for cpu in wanted:
        # No features beside the name: Numba would add those of this machine. Its names of symbols
        # follow the order of sets.
        target = {"NUMBA_CPU_NAME": cpu, "NUMBA_CPU_FEATURES": "", "PYTHONHASHSEED": "0"}
        run(["-m", "rs_localizer", "warm", *solvers], **target, NUMBA_CACHE_DIR=str(folder))
    (folder / "about.json").write_text(json.dumps(about | {"cpus": wanted}) + "\n")
    size = sum(path.stat().st_size for path in folder.rglob("*.nb?"))
    print(f"{folder}: kernels for {' and '.join(wanted)}, {size / 1e6:.0f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
