# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The spline's laws, each factor's derivatives against differences, the system against dense
algebra."""

from dataclasses import replace

import numpy as np
import projector
import pytest
from dense import are_derivatives, fitting, normal_of
from projector import make_camera
from test_fit import READOUT

from rs_localizer.core import so3
from rs_localizer.tools.adjust import factors, variables
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.spline import Layout, Spline
from rs_localizer.tools.adjust.system import Factored, Quadratic, System

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


MOUNTED = variables.Extrinsics(
    so3.exp(np.array([0.1, 0.2, -0.1])), np.array([0.05, -0.02, 0.1]), 2e-3
)
FREEDOMS = {
    "board": variables.Freedom(lens=True, landmarks=0.01, stamps=1e-3),
    "paper": variables.Freedom(lens=True, landmarks=0.01, paper=True),
    "faded": variables.Freedom(lens=True, fading=0.1),
    "mounted": variables.Freedom(lens=True, mount=True),
    "bodies": variables.Freedom(readout_time=False),
}


def small(
    of: str = "board", direction: str = "top_to_bottom", distortion: str = "plumb_bob",
    controls: float = 0.4,
) -> tuple[Problem, variables.Unknowns]:  # fmt: skip
    rng, camera = np.random.default_rng(0), make_camera(scan_direction=direction)
    if distortion == "equidistant":
        camera = replace(camera, D=np.array([0.01, -0.02, 0.003, 0.001]),
                         distortion_model=distortion)  # fmt: skip
    motion, landmarks = projector.Motion.random(rng), projector.room(rng, 8)
    layout = Layout.over(np.array([[0.0, controls]]), 0.04)
    spline = Spline(layout, *motion.poses(layout.control_times()))
    count = 60
    pixels, frames = rng.uniform(0.0, 400.0, (count, 2)), np.sort(rng.integers(0, 5, count))
    seen = variables.SplineKeypoints(
        camera, 0.05 + 0.07 * frames, camera.row_time(pixels), pixels,
        landmarks=landmarks, points=rng.integers(0, 8, count), frames=frames,
        trusted=np.ones(count, bool),
        bodies=np.repeat([-1, 0], 4) if of == "bodies" else None,
    )  # fmt: skip
    state = variables.start_state(seen, spline, READOUT)
    extrinsics = MOUNTED if FREEDOMS[of].mount else state.extrinsics
    state = replace(state, delays=rng.normal(0.0, 1e-3, 5), extrinsics=extrinsics)
    return fitting(Problem([variables.CameraView(seen, FREEDOMS[of])], state), state), state


@pytest.mark.parametrize("of", list(FREEDOMS))
@pytest.mark.parametrize(
    ("direction", "distortion"), [("top_to_bottom", "plumb_bob"), ("right_to_left", "equidistant")]
)
def test_keypoints(of, direction, distortion):
    problem, state = small(of, direction, distortion)
    are_derivatives(lambda one: problem.keypoint_rows(one, 100.0)[0], problem, state)


ACCELERATIONS = variables.Freedom(angular_acceleration=3.0, linear_acceleration=2.0)
FADING = replace(ACCELERATIONS, fading=0.1)


@pytest.mark.parametrize(
    ("rows", "controls"),
    [
        (lambda problem, start, one: factors.acceleration_rows(one.spline, ACCELERATIONS), 0.4),
        (lambda problem, start, one: factors.acceleration_rows(one.spline, FADING), 0.4),
        (lambda problem, start, one: factors.rest_rows(one.spline, 2.0, 1.0), 0.04),  # images alone
        (lambda problem, start, one: factors.Floating(start.spline).rows(one.spline), 0.4),
        (lambda problem, start, one: factors.block_rows(
            one.delays[:, None], np.full(5, 0.5), problem.at[0]["delays"].start), 0.4),
    ],
    ids=["accelerations", "fading", "rest", "the whole", "blocks"],
)  # fmt: skip
def test_what_is_expected_of_the_motion(rows, controls):
    problem, state = small(controls=controls)
    are_derivatives(lambda one: rows(problem, state, one), problem, state)


def test_a_gyroscope():
    problem, state = small()
    mount = variables.GyroMount(
        MOUNTED.axes, np.array([0.02, -0.01, 0.03]), 0.003, np.full(6, 0.02)
    )
    samples = variables.GyroSamples(np.linspace(0.05, 0.3, 7), np.zeros((7, 3)), 1e4)
    seen = replace(problem.views[0].observations, gyro=samples)
    state = replace(state, mount=mount)
    problem = Problem([replace(problem.views[0], observations=seen)], state)
    # So that Tukey's weights are one.
    gyro = factors.Gyroscope(samples, state)
    are_derivatives(lambda one: gyro.terms(one, problem.at[0]["gyro"].start)[0], problem, state)


@pytest.mark.parametrize(
    ("of", "count"), [("board", 2), ("paper", 2), ("mounted", 1), ("bodies", 1)]
)
def test_what_is_known_beforehand(of, count):
    """Of lens and landmarks: the slope is half the derivative of the cost."""
    problem, state = small(of)
    step = 1e-4 * np.ones(problem.groups.kept)
    step[: problem.groups.motion] = 0.0
    off = problem.moved(state, np.r_[step, np.zeros(problem.groups.blocks)])

    def priors(one: variables.Unknowns) -> list[Quadratic]:
        return [term for term in problem.terms(one, 100.0) if isinstance(term, Quadratic)]

    known = priors(off)
    assert len(known) == count
    for k, term in enumerate(known):
        for column, slope in zip(term.columns, term.slope, strict=True):
            step = np.zeros(problem.groups.kept + problem.groups.blocks)
            step[column] = 1e-6
            costs = [priors(problem.moved(off, s * step))[k].cost for s in (1, -1)]
            assert (costs[0] - costs[1]) / 4e-6 == pytest.approx(slope, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("of", ["board", "paper", "faded", "bodies"])
@pytest.mark.parametrize("length", [0.24, 2.0])  # a dense motion, and a band
def test_steps_and_covariances_are_those_of_the_dense_system(of, length):
    problem, state = small(of, controls=length)
    terms = problem.terms(state, 1.0)
    rng = np.random.default_rng(2)
    terms[0] = terms[0]._replace(errors=rng.normal(size=terms[0].errors.shape))
    system = System(problem.groups, terms)
    assert system.dense == (length < 1.0)
    matrix, slope = normal_of(problem.groups, terms)
    scale, factored = 1.0 / np.sqrt(np.diag(matrix)), Factored(system)
    inverse = np.linalg.inv(matrix * scale * scale[:, None]) * scale * scale[:, None]
    expected = -inverse @ slope
    dense = Factored(System(problem.groups, terms, dense=True))  # as a map's is, however long
    for one in (factored, dense):
        np.testing.assert_allclose(one.step(), expected, atol=1e-5 * np.abs(expected).max())
    assert dense.modes(3).shape == (problem.groups.kept, 3)
    motion, kept = problem.groups.motion, problem.groups.kept
    border = inverse[motion:kept, motion:kept]
    scale = np.sqrt(np.diag(border))
    np.testing.assert_allclose(
        factored.border_covariance() / scale / scale[:, None], border / scale / scale[:, None],
        atol=1e-5,
    )  # fmt: skip
    firsts = rng.integers(0, motion // 6 - 3, 4)
    for first, found in zip(firsts, factored.local_covariances(firsts), strict=True):
        own = inverse[6 * first : 6 * first + 24, 6 * first : 6 * first + 24]
        np.testing.assert_allclose(found, own, atol=1e-5 * np.abs(own).max())
