# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cumulative B-spline: laws of its values and derivatives, against finite differences."""

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.tools.adjust.spline import Layout, Spline

H = 1e-6


def random_spline(rng: np.random.Generator, turn: float, count: int = 9) -> Spline:
    rotations = np.empty((count, 3, 3))
    rotations[0] = so3.exp(rng.normal(size=3))
    for k in range(1, count):
        rotations[k] = rotations[k - 1] @ so3.exp(turn * rng.normal(size=3))
    layout = Layout.over(np.array([[1.0, 1.0 + 0.05 * (count - 3)]]), 0.05)
    return Spline(layout, rotations, rng.normal(size=(count, 3)))


@pytest.mark.parametrize("turn", [0.0, 1e-6, 0.2, 1.0])
def test_rates_are_derivatives_of_the_pose(turn):
    rng = np.random.default_rng(1)
    spline = random_spline(rng, turn)
    t = rng.uniform(1.01, 1.28, 20)
    before, now, after = (spline.states(t + d) for d in (-H, 0.0, H))
    turned = np.array([
        so3.log(np.ascontiguousarray(a.T @ b))
        for a, b in zip(before.rotations, after.rotations, strict=True)
    ])  # fmt: skip
    np.testing.assert_allclose(now.angular, turned / (2 * H), atol=1e-6 + 1e-6 * turn)
    np.testing.assert_allclose(
        now.linear, (after.positions - before.positions) / (2 * H), atol=1e-6
    )
    np.testing.assert_allclose(
        now.angular_acceleration, (after.angular - before.angular) / (2 * H), atol=1e-4, rtol=1e-6
    )
    np.testing.assert_allclose(
        now.linear_acceleration, (after.linear - before.linear) / (2 * H), atol=1e-3
    )


@pytest.mark.parametrize("turn", [0.0, 1e-6, 0.2, 1.0])
def test_jacobians_are_finite_differences(turn):
    rng = np.random.default_rng(2)
    spline = random_spline(rng, turn)
    t = np.array([1.0, 1.013, 1.05, 1.171, 1.3])
    first, analytic = spline.jacobians(t)
    for k in range(6 * len(spline.positions)):
        step = np.zeros(6 * len(spline.positions))
        step[k] = H
        plus, minus = spline.moved(step).states(t), spline.moved(-step).states(t)
        numeric = np.column_stack([
            [so3.log(np.ascontiguousarray(a.T @ b))
             for a, b in zip(minus.rotations, plus.rotations, strict=True)],
            plus.positions - minus.positions,
            plus.angular - minus.angular,
            plus.linear - minus.linear,
        ]) / (2 * H)  # fmt: skip
        for m in range(len(t)):
            local = k - 6 * first[m]
            expected = analytic[m, :, local] if 0 <= local < 24 else np.zeros(12)
            np.testing.assert_allclose(numeric[m], expected, atol=2e-6, rtol=1e-6)
