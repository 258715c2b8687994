"""Where the numbers of a motion stand: in its state, and in a step or a covariance.

A state holds rotation (9, row-major) and translation (3), camera_from_map at the middle row, the
angular and linear velocities (3, 3) and the accelerations (3, 3) there, per readout and per
readout squared (:class:`rs_localizer.core.shutter.Motion`). A step has three parameters for the
rotation; it is what :func:`rs_localizer.estimation.refine.apply_step` applies.
"""

from __future__ import annotations

STATE_SIZE = 24
PARAMETERS = 18
# Pose and velocities: what a search knows, and what ``Estimate.covariance`` is of.
MOTION_PARAMETERS = 12

# Of a step: the camera turns, moves in its own axes, and changes its velocities and accelerations.
TURN, MOVE, ANGULAR, LINEAR, ANGULAR_ACCELERATION, LINEAR_ACCELERATION = (
    slice(k, k + 3) for k in range(0, PARAMETERS, 3)
)
POSE, VELOCITIES, ACCELERATIONS = slice(0, 6), slice(6, 12), slice(12, 18)
