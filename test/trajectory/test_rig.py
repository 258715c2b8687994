# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs that are calibrated with recordings of the tests' own projector."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import projector
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.observe import Observed
from rs_localizer.tools.calibration import calibrate
from rs_localizer.tools.rig import Recording, calibrate_rig

CAMERA = Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, D=projector.D)
# The second camera looks back, 10 cm beside the first, its shutter runs up, its images come 7 ms
# after those of the first, and its clock is 1.2 s late.
AXES = Rotation.from_euler("yx", [175.0, 10.0], degrees=True).as_matrix()
CENTRE = np.array([0.1, -0.02, -0.05])
READOUTS, PHASE, OFFSET = (0.02, -0.03), 0.0071, 1.2


@dataclass
class Carried:
    """A camera on a body that moves, whose time begins later."""

    body: projector.Motion
    axes: np.ndarray
    centre: np.ndarray
    later: float

    def pose(self, t):
        rotations, positions = self.body.pose(np.asarray(t) + self.later)
        return rotations @ self.axes.T, positions + rotations @ self.centre


@cache
def recording(place):
    """Of one of the cameras: each sees a board of its own."""
    rng = np.random.default_rng(3)
    motion = projector.Motion.random(rng, 0.1, 0.08)
    axes, centre = ((np.eye(3), np.zeros(3)), (AXES, CENTRE))[place]
    phase, clock = place * PHASE, place * OFFSET
    points = projector.board() @ axes + centre
    frames = projector.record(
        rng, Carried(motion, axes, centre, phase), points, readout=READOUTS[place], seconds=2.5,
        noise=0.1,
    )  # fmt: skip
    images = [
        Observed(round(1e9 * (10.0 + f.stamp + phase - clock)), f.points, f.pixels) for f in frames
    ]
    return Recording(CAMERA, calibrate(CAMERA, images))


@cache
def pair():
    return calibrate_rig({"front": recording(0), "rear": recording(1)})


def test_a_pair_that_never_sees_the_same():
    rig = pair()
    front, rear = rig["front"], rig["rear"]
    np.testing.assert_array_equal(front.extrinsics.axes, np.eye(3))
    assert front.extrinsics.offset == 0.0
    assert not front.deviations.any()
    assert front.undetermined == rear.undetermined == ""
    for mounted, readout in zip((front, rear), READOUTS, strict=True):
        assert mounted.readout_time == pytest.approx(readout, abs=2e-4)
    mounted = rear.extrinsics
    turn = Rotation.from_matrix(mounted.axes @ AXES.T).as_rotvec()
    errors = np.r_[turn, mounted.centre - CENTRE, mounted.offset - OFFSET]
    assert np.all(np.abs(errors) < 4.0 * rear.deviations)
    assert np.all(rear.deviations < [2e-3, 2e-3, 2e-3, 5e-3, 5e-3, 5e-3, 2e-4])


def test_motions_that_are_not_one_are_refused():
    front = recording(0)
    fit = front.calibration.fit
    spline = fit.state.spline
    back = replace(spline, rotations=np.roll(spline.rotations[::-1], 20, axis=0))
    fit = replace(fit, state=replace(fit.state, spline=back))
    rear = front._replace(calibration=replace(front.calibration, fit=fit))
    with pytest.raises(
        ValueError, match=r"rear: its rotation does not match that of the first camera \(to"
    ):
        calibrate_rig({"front": front, "rear": rear})
    with pytest.raises(ValueError, match="several cameras, not 1"):
        calibrate_rig({"front": front})
