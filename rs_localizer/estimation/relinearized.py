"""Derivatives of pixels by rays where a motion sees the points, for frames of many points.

Taken where the points were measured, they have the noise of the points in them. Through a lens that
bends much (a fisheye), and by a known turn, that makes the columns of a motion differ a little from
fields of errors that it can mimic, in step with the errors: thousands of points take it for a map
or a lens that is wrong.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.gyro_compensated import gyro_compensated
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.residuals import linearized

# What fewer points see of it is lost in their noise.
_MANY = 300
# Errors beyond which (px) the motion says nothing of where a point ought to be.
_NEAR = 10.0


def relinearized(
    camera: Camera,
    observations: Observations,
    state: Array,
    turn: KnownTurn | None,
    fewest: int = _MANY,
) -> Observations:
    """The same observations with derivatives at a motion near the best; few points as they are.

    Args:
        state: (24,) of the motion.
        turn: what the observations are compensated by.
        fewest: points that are not few.
    """
    count = len(observations)
    if count < fewest or (len(camera.D) == 0 and turn is None):
        return observations
    gradient = observations.row_time_gradient
    lines = linearized(observations.packed, count, state, gradient, np.zeros((count, 6)))
    near = np.abs(lines.errors).max(axis=1) < _NEAR  # NaN compares false
    rays = np.where(near[:, None], lines.image, observations.rays)
    if turn is None:
        by_ray = camera.pixel_jacobian(rays)
    else:
        local = np.einsum(
            "nij,nj->ni", turn.at_rows(observations.tau)[0], np.column_stack([rays, np.ones(count)])
        )
        raw = local[:, :2] / local[:, 2:]
        by_ray = gyro_compensated(
            raw, observations.tau, camera.pixel_jacobian(raw), gradient, turn
        )[1]
    return Observations.of(
        observations.points, observations.rays, observations.tau, by_ray, gradient
    )
