# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures of ``docs/mapping.md``:

python -m benchmarks.mapping bend bound large regions surveys rendered coverage rigs
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator

from benchmarks.mapping.refining import bend, bound, large, regions
from benchmarks.mapping.surveying import coverage, rendered, rigs, surveys
from rs_localizer.cli.options import integer

_PARTS: dict[str, Callable[[int], Iterator[str]]] = {
    "bend": bend, "bound": bound, "large": large, "regions": regions, "surveys": surveys,
    "rendered": rendered, "coverage": coverage, "rigs": rigs,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mapping")
    parser.add_argument("names", nargs="+", metavar="PART", choices=_PARTS, help=", ".join(_PARTS))
    parser.add_argument("--seed", type=integer(0), default=0, metavar="N")
    options = parser.parse_args()
    for name in options.names:
        for text in _PARTS[name](options.seed):
            sys.stdout.write(f"{text}\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
