# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A correction of odometry in the plane and in space."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.io.transforms import Transform
from rs_localizer.pipeline.carried_pose import corrected


def test_in_the_plane_the_body_has_its_x_and_y_and_heading():
    tilted = Transform(
        Rotation.from_euler("zyx", [0.7, 0.02, -0.03]).as_matrix(), np.array([3.0, 4.0, 0.2])
    )
    odometry = Transform(Rotation.from_euler("z", 0.4).as_matrix(), np.array([-1.0, 2.0, 0.0]))
    flat = corrected(tilted, odometry, two_d=True)
    body = flat @ odometry
    assert body.translation == pytest.approx([3.0, 4.0, 0.0])
    assert Rotation.from_matrix(body.rotation).as_euler("zyx") == pytest.approx(
        [0.7, 0, 0], abs=1e-3
    )
    whole = corrected(tilted, odometry, two_d=False) @ odometry
    assert whole.translation == pytest.approx(tilted.translation)
    assert whole.rotation == pytest.approx(tilted.rotation)
