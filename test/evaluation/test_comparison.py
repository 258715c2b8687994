# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Answers beside the truth: what is compared, what is counted, and the table of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.trajectories import Trajectory, Twists
from rs_localizer.tools.evaluation.comparison import (
    Answer,
    Recording,
    Result,
    compare,
    counts_at,
    load_recording,
    predicted_pixels,
    table,
    true_rates,
)
from rs_localizer.tools.evaluation.metrics import Errors, associate, pose_errors, twist_errors
from rs_localizer.tools.evaluation.plots import errors

MIDDLE_NS = 15_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    """A simulated recording of 30 frames that turns by 200 deg/s."""
    bag = tmp_path_factory.mktemp("comparison") / "bag"
    rate = str(np.radians(200.0))
    assert (
        main(["simulate", str(bag), "--duration", "1", "--angular-velocity", "0", rate, "0"]) == 0
    )
    return load_recording(bag)


def answers(recording: Recording, *, moving: bool, shift: float) -> dict[int, Answer]:
    """True answers, shifted, to all frames but the third."""
    assert recording.truth is not None
    truth, twists = recording.truth.poses, recording.truth.twists
    assert twists is not None
    found = {}
    for stamp in recording.stamps_ns[:2] + recording.stamps_ns[3:]:
        row = truth.stamps_ns.tolist().index(stamp + MIDDLE_NS)
        found[stamp] = Answer(
            stamp,
            0.01,
            stamp + MIDDLE_NS,
            truth.positions[row] + np.array([0.0, shift, 0.0]),
            truth.quaternions[row],
            twists.angular[row] if moving else None,
            twists.linear[row] if moving else None,
            np.array([0.3, 0.4]),
        )
    return found


@pytest.fixture
def results(recording) -> dict[str, Result]:
    return {
        "good": compare(answers(recording, moving=True, shift=0.002), recording.truth),
        "bad": compare(answers(recording, moving=False, shift=0.05), recording.truth),
    }


def test_table(recording, results):
    np.testing.assert_allclose(results["good"].errors.true_angular_rate, 200.0)
    np.testing.assert_allclose(true_rates(recording), 200.0)
    counts = counts_at(results["good"], recording.stamps_ns)
    assert counts[2] == 0.0
    assert counts.sum() == 2 * (len(recording.stamps_ns) - 1)
    text = table("A flight", recording, results)
    lines = {line[:44].strip(): line[44:].split() for line in text.splitlines()}
    assert all(len(line) <= 80 for line in text.splitlines())
    assert lines["A flight"] == ["good", "bad"]
    count = len(recording.stamps_ns)
    assert lines["frames"] == [str(count)] * 2
    assert lines["localized"][0] == str(count - 1)
    assert lines["residual of the inliers, median (px rms)"] == ["0.354"] * 2
    assert lines["position error, median (mm)"] == ["2.0", "50.0"]
    assert lines["where the camera turns > 150 deg/s"][0] == "0.0"
    assert lines["angular velocity error, median (deg/s)"] == ["0.0", "-"]
    assert lines["latency, 50 / 95 % (ms)"] == ["10.0", "/", "10.0"] * 2
    # Without truth there is nothing to say about errors, and no empty lines about it.
    blind = Recording(recording.stamps_ns, [], recording.clouds, {}, None)
    assert "error" not in table("A flight", blind, {"good": compare({}, None)})


def project(camera: Camera, points: Array, rotation: Rotation, centre: Array) -> Array:
    return camera.project(rotation.inv().apply(points - centre))


def test_predicted_pixels_move_with_the_rows():
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    camera = Camera(640, 480, K, readout_time=0.03)
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.0, -0.8, 3.0], [1.0, 0.8, 5.0], size=(50, 3))
    start = Rotation.from_rotvec([0.01, -0.02, 0.03])
    angular, linear = np.array([1.0, -2.0, 0.5]), np.array([0.5, 0.2, -0.3])
    answer = Answer(0, 0.0, 0, np.zeros(3), start.as_quat(), angular, linear, np.zeros(0))
    pixels = predicted_pixels(camera, answer, points)
    for point, pixel in zip(points, pixels, strict=True):
        late = 0.03 * (pixel[1] / 479 - 0.5)
        turned = start * Rotation.from_rotvec(late * angular)
        seen = project(camera, point[None], turned, late * start.apply(linear))
        np.testing.assert_allclose(seen[0], pixel, atol=1e-6)
    static = Answer(0, 0.0, 0, np.zeros(3), start.as_quat(), None, None, np.zeros(0))
    expected = project(camera, points, start, np.zeros(3))
    np.testing.assert_allclose(predicted_pixels(camera, static, points), expected, atol=1e-9)


RNG = np.random.default_rng(0)
STAMPS = 1_500_000_000_000_000_000 + np.arange(10, dtype=np.int64) * 33_333_333
ROTATIONS = Rotation.from_quat(RNG.normal(size=(10, 4)))
TRUTH = Trajectory(STAMPS, RNG.normal(size=(10, 3)), ROTATIONS.as_quat())


def test_associate_takes_the_nearest_within_the_tolerance():
    true = np.array([10, 20, 30, 40], np.int64)
    estimated = np.array([0, 8, 16, 25, 30, 33, 47], np.int64)
    rows, true_rows = associate(estimated, true, 5)
    assert rows.tolist() == [1, 2, 3, 4, 5]
    assert true_rows.tolist() == [0, 1, 1, 2, 2]
    rows, true_rows = associate(estimated, true, 0)
    assert (rows.tolist(), true_rows.tolist()) == ([4], [2])


def test_pose_errors_are_in_metres_and_degrees():
    # Rotations about different axes by 5 degrees, in the body's own axes; a sign means nothing.
    axes = RNG.normal(size=(10, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turned = Rotation.from_quat(TRUTH.quaternions) * Rotation.from_rotvec(np.radians(5.0) * axes)
    moved = Trajectory(STAMPS, TRUTH.positions + 0.02 * axes, -turned.as_quat())
    errors = pose_errors(moved, TRUTH)
    np.testing.assert_allclose(errors.linear, 0.02)
    np.testing.assert_allclose(errors.angular, 5.0)
    np.testing.assert_array_equal(errors.stamps_ns, STAMPS)
    assert len(pose_errors(moved.part(slice(3, 6)), TRUTH).linear) == 3


def test_twist_errors():
    angular, linear = RNG.normal(size=(10, 3)), RNG.normal(size=(10, 3))
    true = Twists(STAMPS, angular, linear)
    off = Twists(STAMPS, angular + np.array([0.0, 0.03, 0.04]), linear - np.array([0.6, 0, 0.8]))
    errors = twist_errors(off, true)
    np.testing.assert_allclose(errors.angular, np.degrees(0.05))
    np.testing.assert_allclose(errors.linear, 1.0)
    np.testing.assert_allclose(
        errors.true_angular_rate, np.degrees(np.linalg.norm(angular, axis=1))
    )


def test_errors_show_the_worst_frame():
    values = np.full(400, 0.01)
    values[77] = 30.0
    figure = errors({"estimate": Errors(np.arange(400) * 10**8, values, values, values)}, {})
    place, _ = figure.axes
    assert place.get_ylim()[1] > 30_000.0
    assert place.get_legend_handles_labels()[1] == ["estimate: median 10 mm, largest 3e+04"]
