# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Machine code that came with the package, where nobody wants to wait for a compiler.

``packaging/compile_kernels.py`` puts it there before a wheel is built: caches of kernels
(:mod:`rs_localizer.core.simd.jit`) of processes that compiled for a kind of CPU and not for their
own. What a CPU can do decides here which of it may run: an instruction that it does not have would
end the process.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / "compiled"
"""Where it is in the package; in most sources it is not."""

# The levels of the x86-64 psABI (section 3.1.1), as LLVM names their features.
_V3 = frozenset(
    "cx16 sahf popcnt sse3 sse4.1 sse4.2 ssse3 avx avx2 bmi bmi2 f16c fma lzcnt movbe xsave".split()
)
LEVELS = {
    "x86-64-v4": _V3 | frozenset("avx512f avx512bw avx512cd avx512dq avx512vl".split()),
    "x86-64-v3": _V3,
}
"""What a CPU of each level can do; the fastest comes first."""


@functools.cache
def levels(features: str) -> tuple[str, ...]:
    """The levels whose code runs where these features are, the fastest first.

    Args:
        features: as LLVM lists them, ``+avx,-avx2``. Numba leaves out what its settings forbid.
    """
    there = {name[1:] for name in features.split(",") if name.startswith("+")}
    return tuple(name for name, needed in LEVELS.items() if needed <= there)


def keys(key: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    """Under which keys Numba may have filed what is looked for under this one, the fastest first.

    Args:
        key: of a signature, a target (triple, CPU, features) and the function's bytecode.
    """
    signature, (triple, _, features), bytecode = key
    return [(signature, (triple, level, ""), bytecode) for level in levels(features)]
