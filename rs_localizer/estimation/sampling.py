"""Minimal samples: drawn inside a kernel, from a pool of points, best points first if ranked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import inlined, kernel

Random = NDArray[np.uint64]  # (1,), the state of the generator


def generator(seed: int) -> Random:
    """A random generator that kernels can draw from."""
    return np.array([seed], dtype=np.uint64)


# A sample whose rows lie closer together than this part of all rows hardly sees the motion.
_LEAST_ROW_SPREAD = 0.25
_MOST_REDRAWS = 8
# After so many samples a ranked pool is drawn from as a whole (T_N of the PROSAC paper).
_RANKED_HORIZON = 200_000


@dataclass(frozen=True, slots=True, eq=False)
class Pool:
    """Points to draw from.

    ``ranked``: they are sorted from the best to the worst and the first samples come from the
    first of them (PROSAC: Chum, Matas, "Matching with PROSAC", CVPR 2005).
    """

    points: IntArray
    ranked: bool = False

    def prefix_sizes(self, first: int, count: int, size: int) -> IntArray:
        """From how many points of the pool samples ``first ... first + count - 1`` are drawn."""
        total = len(self.points)
        if not self.ranked or total <= size:
            return np.full(count, total, dtype=np.int64)
        n = np.arange(size, total + 1)
        # Expected number of the horizon's samples that lie in the first n points (T_n there).
        factors = (n[:, None] - np.arange(size)) / (total - np.arange(size))
        expected = _RANKED_HORIZON * np.prod(factors, axis=1)
        drawn = np.arange(first + 1, first + count + 1)
        return np.minimum(size + np.searchsorted(expected, drawn), total).astype(np.int64)


@inlined
def _next(random: Any) -> Any:
    """SplitMix64 (Steele, Lea, Flood, OOPSLA 2014): the next 64 bits; ``random`` is (1,) uint64."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def draw(pool: Any, prefixes: Any, tau: Array, row_range: float, random: Any, samples: Any) -> None:
    """Fill ``samples`` (h,n) with distinct points of the pool, row by row.

    Sample ``h`` comes from the first ``prefixes[h]`` points, which must be at least n.
    """
    count, size = samples.shape
    for h in range(count):
        for _ in range(_MOST_REDRAWS):
            first, last = np.inf, -np.inf
            for i in range(size):
                repeated = True
                while repeated:
                    # The upper 32 bits times the size: unbiased to 2^-32 and without a division.
                    position = ((_next(random) >> np.uint64(32)) * np.uint64(prefixes[h])) >> (
                        np.uint64(32)
                    )
                    point = pool[position]
                    repeated = False
                    for k in range(i):
                        repeated = repeated or samples[h, k] == point
                samples[h, i] = point
                first = min(first, tau[point])
                last = max(last, tau[point])
            if last - first >= _LEAST_ROW_SPREAD * row_range:
                break
