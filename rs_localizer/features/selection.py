"""Which keypoints of an image are kept: good ones, and some of every part of it.

A pose is as certain as the points are spread; the best keypoints alone lie where most texture is.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, IntArray

# Keypoints that a cell of the grid holds on average.
_PER_CELL = 8


def balanced(pixels: Array, scores: Array, size: tuple[int, int], most: int) -> IntArray:
    """Rows (k,) of at most so many keypoints: of each cell of a grid the best, then the second ...

    Args:
        pixels: (n,2)
        scores: (n,) higher is better.
        size: width and height of the image.
        most: how many to keep.
    """
    count = len(pixels)
    if count <= most:
        return np.arange(count)
    side = np.sqrt(size[0] * size[1] * _PER_CELL / most)
    columns, rows = (pixels // side).astype(np.int64).T
    cells = rows * (int(size[0] // side) + 1) + columns
    order = np.lexsort((-scores, cells))
    ranks = np.arange(count) - np.searchsorted(cells[order], cells[order])
    return np.sort(order[np.lexsort((-scores[order], ranks))[:most]])
