# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How fast a motion changes, as a time lapse has it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.mapping.initial_trajectory import usual_accelerations


def test_accelerations_of_a_time_lapse_are_those_of_its_own_time():
    """Round a place of 3 m in three seconds, nodding twice a second."""
    times = 0.04 * np.arange(75)
    angle, nod = 2.0 * np.pi * times / 3.0, 4.0 * np.pi
    positions = 3.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    turns = np.zeros((75, 3))
    turns[:, 0] = 0.2 * np.sin(nod * times)
    rotations = Rotation.from_rotvec(turns).as_matrix()
    angular, linear = usual_accelerations(times, rotations, positions)
    # Rms over the axes: two of the three take part in the circle, one in the nod.
    assert linear == pytest.approx(3.0 * (2.0 * np.pi / 3.0) ** 2 / np.sqrt(3.0), rel=0.02)
    assert angular == pytest.approx(0.2 * nod**2 / np.sqrt(6.0), rel=0.05)


def test_images_on_their_own_have_none():
    times = np.arange(5.0)
    assert usual_accelerations(times, np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3))) == (0, 0)
