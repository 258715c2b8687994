"""How well surveyed markers are known beside each other, wherever the whole of them lies.

In the frame of one marker, the errors of its own orientation grow with the distance from it. Held
by all corners together (inner constraints, free network) what is left is the error of the shape
alone: Baarda's S-transform, as in :mod:`rs_localizer.mapping.gauge`, which frees the size as well.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.trajectory.bodies import BODY, PLACE


def of_the_shape(covariance: Array, corners: Array) -> Array:
    """Covariance (6 m, 6 m) of places and turns (along the map's axes) when all corners hold the
    whole: of all rigid motions that lay them over the truth, the best is the identity.

    Args:
        covariance: (6 m, 6 m) in any frame.
        corners: (m,4,3) m.
    """
    middles = corners.mean(axis=1)
    origin = middles.mean(axis=0)
    whole = np.tile(np.eye(BODY), (len(corners), 1, 1))  # how a marker moves with the whole
    whole[:, :PLACE, PLACE:] = -so3.hat(middles - origin)
    by_marker = np.zeros((len(corners), corners.shape[1], PLACE, BODY))  # and corners with it
    by_marker[..., :PLACE] = np.eye(PLACE)
    by_marker[..., PLACE:] = -so3.hat(corners - middles[:, None])
    weights = np.einsum("mcij,mcik->mjk", by_marker, by_marker)
    weighted = weights @ whole
    moved = np.linalg.inv(np.einsum("mij,mik->jk", whole, weighted))
    every, held = whole.reshape(-1, BODY), weighted.reshape(-1, BODY)
    free = np.eye(len(every)) - every @ moved @ held.T
    out: Array = free @ covariance @ free.T
    return out
