# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3

# Angles from nothing to a half turn; the small ones cross the switch to the series.
angles = st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 9.9e-4, 1.01e-3, 0.1, 1.0, 2.5, np.pi - 1e-6])
axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1)


def vector(axis, angle):
    return angle * np.array(axis) / np.linalg.norm(axis)


@given(axes, angles)
def test_exp_is_the_rotation_of_scipy(axis, angle):
    rotation = so3.exp(vector(axis, angle))
    expected = Rotation.from_rotvec(vector(axis, angle)).as_matrix()
    np.testing.assert_allclose(rotation, expected, atol=1e-14)


@given(axes, angles)
def test_log_undoes_exp(axis, angle):
    back = so3.log(so3.exp(vector(axis, angle)))
    np.testing.assert_allclose(back, vector(axis, angle), atol=1e-8 if angle > 3 else 1e-13)


def test_hat_is_the_cross_product():
    first, second = np.array([0.3, -1.2, 0.7]), np.array([-0.5, 0.4, 2.0])
    expected = np.cross(first, second)
    np.testing.assert_allclose(so3.hat_of(first) @ second, expected, atol=1e-15)
    np.testing.assert_allclose(so3.hat(first) @ second, expected, atol=1e-15)


@given(axes, angles)
def test_quaternion_is_that_of_scipy_with_positive_w(axis, angle):
    matrix = so3.exp(vector(axis, angle))
    expected = Rotation.from_matrix(matrix).as_quat()
    expected *= np.sign(expected[3]) or 1.0
    np.testing.assert_allclose(so3.quaternion(matrix), expected, atol=1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_have_a_logarithm(axis):
    matrix = 2.0 * np.outer(axis, axis) - np.eye(3)
    vector_of = so3.log(matrix)
    assert np.linalg.norm(vector_of) == pytest.approx(np.pi)
    np.testing.assert_allclose(so3.exp(vector_of), matrix, atol=1e-12)


@given(axes, angles, st.integers(0, 2))
def test_right_jacobian_is_the_derivative_of_the_exponential(axis, angle, direction):
    at, step = Rotation.from_rotvec(vector(axis, angle)), 1e-6 * np.eye(3)[direction]
    ahead, behind = (Rotation.from_rotvec(at.as_rotvec() + s) for s in (step, -step))
    change = (behind.inv() * ahead).as_rotvec() / 2e-6
    jacobian = so3.right_jacobian(vector(axis, angle))
    np.testing.assert_allclose(jacobian[:, direction], change, atol=1e-8)
