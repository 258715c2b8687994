# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The simulator of cameras, rigs and IMUs against independent projections and differences."""

import math

import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation

from rs_localizer import data
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import open_bag
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters
from rs_localizer.io.trajectories import Trajectory, read_tum
from rs_localizer.settings import write_parameters
from rs_localizer.tools.simulation import simulated_frames, simulated_imu, true_motion
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_recording import MountedMotion

K = np.array([[400.0, 0.0, 319.5], [0.0, 410.0, 239.5], [0.0, 0.0, 1.0]])
MOTION = true_motion.ConstantVelocity(np.array([0.6, -2.0, 1.5]), np.array([1.0, 0.5, 0.25]), 1.0)
MAP = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
CLEAN = simulated_frames.FrameSettings(points=100, noise=0.0, outliers=0.0)


def camera(direction: str = "top_to_bottom") -> Camera:
    return Camera(640, 480, K, readout_time=0.03, scan_direction=direction)


def frames(direction: str = "top_to_bottom") -> list[simulated_frames.SimulatedFrame]:
    return list(simulated_frames.simulate_frames(camera(direction), MOTION, MAP, CLEAN))


@pytest.mark.parametrize("direction", list(ScanDirection))
def test_each_point_is_seen_at_the_time_of_its_row(direction):
    """Independent of row_time and project_rolling: plain geometry at each pixel's exposure."""
    for frame in frames(direction=direction)[::10]:
        assert len(frame.points) == 100
        u, v = frame.pixels.T
        late = {
            "top_to_bottom": v / 479,
            "bottom_to_top": (479 - v) / 479,
            "left_to_right": u / 639,
            "right_to_left": (639 - u) / 639,
        }[direction]
        assert late.min() > -0.01
        assert late.max() < 1.01
        state = MOTION.state(frame.stamp_ns, 0.03 * late)
        local = np.einsum("nji,nj->ni", state.rotations, frame.points - state.positions)
        np.testing.assert_allclose(u, 400 * local[:, 0] / local[:, 2] + 319.5, atol=1e-6)
        np.testing.assert_allclose(v, 410 * local[:, 1] / local[:, 2] + 239.5, atol=1e-6)


def test_points_that_a_lens_folds_back_are_not_seen():
    # Strong barrel distortion: beyond 60 degrees off axis the polynomial runs backwards.
    wide = [[200.0, 0.0, 319.5], [0.0, 205.0, 239.5], [0.0, 0.0, 1.0]]
    lens = Camera(640, 480, wide, [-0.35, 0.0, 0.0, 0.0])
    every = simulated_frames.FrameSettings(points=5000, noise=0.0, outliers=0.0)
    for frame in list(simulated_frames.simulate_frames(lens, MOTION, MAP, every))[::10]:
        x, y, z = frame.motion.rotation @ frame.points.T + frame.motion.translation[:, None]
        np.testing.assert_allclose(lens.rays(frame.pixels), np.c_[x / z, y / z], atol=1e-3)


def test_a_wide_lens_shows_what_lies_behind_it():
    """By equation 12 of Khomutenko, Garcia, Martinet (2016)."""
    wide = [[160.0, 0.0, 319.5], [0.0, 164.0, 239.5], [0.0, 0.0, 1.0]]
    lens = Camera(640, 480, wide, [0.63, 1.05], "eucm")
    behind = 0
    for frame in list(simulated_frames.simulate_frames(lens, MOTION, MAP, CLEAN))[::10]:
        x, y, z = frame.motion.rotation @ frame.points.T + frame.motion.translation[:, None]
        scale = 0.63 * np.sqrt(1.05 * (x**2 + y**2) + z**2) + 0.37 * z
        np.testing.assert_allclose(frame.pixels[:, 0], 160 * x / scale + 319.5, atol=1e-6)
        np.testing.assert_allclose(frame.pixels[:, 1], 164 * y / scale + 239.5, atol=1e-6)
        behind += np.count_nonzero(z < 0.0)
    assert behind > 10


def test_no_frame_touches_a_gap():
    t = np.arange(0.0, 3.0, 1 / 120)
    t = t[((t < 1.0) | (t > 1.4)) & ((t < 2.0) | (t > 2.05))]
    stamps_ns = 1_500_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    motion = true_motion.RecordedMotion(Trajectory(stamps_ns, np.zeros((len(t), 3)), quaternions))
    stamps = np.array(simulated_frames.frame_stamps(motion, camera(), 30.0))
    for stamp in stamps:
        inside = [first <= stamp <= last - 30_000_000 for first, last in motion.intervals_ns]
        assert sum(inside) == 1
    seconds = (stamps - stamps_ns[0]) * 1e-9
    np.testing.assert_allclose(seconds * 30, np.round(seconds * 30), atol=1e-6)
    # All that fit are there: 90 in three seconds, less those that touch 0.4 s and 0.05 s.
    assert 70 <= len(stamps) <= 75


START_NS = 1_520_531_467_575_280_000


def recorded_way(t: Array) -> tuple[Array, Rotation]:
    """A lively smooth motion in closed form."""
    positions = np.stack([np.sin(2.0 * t), 0.5 * np.cos(3.0 * t), 0.2 * t], axis=1)
    vectors = np.stack([0.8 * np.sin(2.5 * t), 0.6 * np.cos(2.0 * t), 1.5 * t], axis=1)
    return positions, Rotation.from_rotvec(vectors)


def recording(t: Array) -> Trajectory:
    positions, rotations = recorded_way(t)
    quaternions = rotations.as_quat()
    quaternions[::3] *= -1.0  # q and -q are the same rotation
    return Trajectory(START_NS + np.round(t * 1e9).astype(np.int64), positions, quaternions)


STEADY = true_motion.ConstantVelocity(
    np.array([0.5, -1.5, 2.0]), np.array([1.0, -0.5, 0.25]), 4.0, start_ns=START_NS
)
TURN = Rotation.from_euler("xyz", [0.1, -0.2, np.pi]).as_matrix()
PLACE = np.array([0.1, -0.2, 0.05])
MOTIONS = {
    "constant": STEADY,
    "shaken": simulated_imu.shaken(STEADY, [(0.3, 60.0), (0.1, 120.0)], np.random.default_rng(2)),
    "mounted": MountedMotion(STEADY, TURN, PLACE),
    "smoothed": true_motion.RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 120))),
    "interpolated": true_motion.RecordedMotion(recording(np.arange(0.0, 4.0, 1 / 39))),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_velocities_are_the_derivatives_of_the_poses(name):
    motion: true_motion.TrueMotion = MOTIONS[name]
    step = 1e-5
    for seconds in (0.5, 1.7, 3.1):
        stamp_ns = START_NS + round(seconds * 1e9)
        state = motion.state(stamp_ns, np.array([-step, 0.0, step]))
        here = state.rotations[1]
        velocity = (state.positions[2] - state.positions[0]) / (2.0 * step)
        turn = Rotation.from_matrix(state.rotations[0].T @ state.rotations[2])
        within = 1e-4 if name == "shaken" else 1e-7
        np.testing.assert_allclose(state.linear[1], here.T @ velocity, atol=within)
        np.testing.assert_allclose(state.angular[1], turn.as_rotvec() / (2.0 * step), atol=within)


@pytest.mark.parametrize(("name", "tolerance"), [("smoothed", 1e-3), ("interpolated", 1e-6)])
def test_spline_follows_the_recording(name, tolerance):
    t = np.linspace(0.1, 3.9, 401)
    state = MOTIONS[name].state(START_NS, t)
    positions, rotations = recorded_way(t)
    expected = rotations.as_matrix() @ true_motion.BODY_FROM_CAMERA
    np.testing.assert_allclose(state.positions, positions, atol=tolerance)
    np.testing.assert_allclose(state.rotations, expected, atol=tolerance)


def test_a_shaken_camera_turns_as_far_as_its_tones():
    times = np.linspace(0.0, 2.0, 4000)
    still, swung = (
        MOTIONS[name].state(START_NS, times).rotations for name in ("constant", "shaken")
    )
    angles = Rotation.from_matrix(np.swapaxes(still, 1, 2) @ swung).magnitude()
    assert np.radians(0.3) < angles.max() <= np.radians(0.4001)


def test_a_mounted_camera_sees_points_where_its_rig_carries_it():
    point = np.array([1.0, 2.0, 3.0])
    rig, camera = (
        MOTIONS[name].state(START_NS, np.array([0.4])) for name in ("constant", "mounted")
    )
    in_rig, in_camera = (
        state.rotations[0].T @ (point - state.positions[0]) for state in (rig, camera)
    )
    np.testing.assert_allclose(in_camera, TURN @ in_rig + PLACE, atol=1e-12)


MATRIX = np.array([[450.0, 0.0, 320.0], [0.0, 450.0, 240.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def rig_recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    cameras = {
        "front": Camera(640, 480, MATRIX, readout_time=0.03),
        "rear": Camera(640, 480, MATRIX, None, "plumb_bob", 0.02, "bottom_to_top"),
    }
    poses = {"front": (np.eye(3), np.zeros(3)), "rear": (TURN, PLACE)}
    parts = RigParts(cameras, poses, {"front": 0.0, "rear": -0.25})
    write_parameters(folder / "chain.yaml", node_parameters(parts), mounted_lenses(parts))
    out = folder / "seen"
    still = ("--duration", 1, "--noise", 0, "--outliers", 0)
    turn = ("--angular-velocity", 0.4, 0.8, -0.5)
    record(out, "--rig", folder / "chain.yaml", *still, *turn)
    return out, parts


def test_pixels_are_those_of_the_row_by_the_cameras_own_clock(rig_recording):
    out, parts = rig_recording
    angular, stamps = np.array([0.4, 0.8, -0.5]), {}
    start = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    with open_bag(out) as bag:
        for name, readout in (("front", 0.03), ("rear", 0.02)):
            clouds = [m for _, _, m in bag.messages((f"/{name}/correspondences",))]
            stamps[name] = [read_correspondences(m).stamp_ns for m in clouds]
            cloud = read_correspondences(clouds[-1])
            rotation, translation = parts.camera_from_rig[name]
            row = cloud.pixels[:, 1] / 479.0
            row = row if name == "front" else 1.0 - row
            # The rig starts to turn about its origin at 1 s of true time; stamps of rear are late.
            times = 1e-9 * cloud.stamp_ns - 1.0 + parts.time_offset[name] + readout * row
            for point, pixel, time in zip(cloud.points, cloud.pixels, times, strict=True):
                map_from_rig = start @ Rotation.from_rotvec(angular * time).as_matrix()
                x, y, z = rotation @ (map_from_rig.T @ point) + translation
                np.testing.assert_allclose(pixel, [450 * x / z + 320, 450 * y / z + 240], atol=2e-3)
    assert all(len(own) >= 28 for own in stamps.values())
    # Clocks run freely: neither at once, nor at the same rate.
    pairs = min(len(s) for s in stamps.values())
    apart = np.array(stamps["rear"][:pairs]) - stamps["front"][:pairs] - 250_000_000
    assert np.abs(apart).min() > 1e5
    assert np.ptp(apart) > 1e3


PERFECT = simulated_imu.ImuSettings(2000.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CAMERA_FROM_IMU = Rotation.from_euler("xyz", [20.0, -70.0, 140.0], degrees=True).as_matrix()
LEVER = simulated_imu.Lever(CAMERA_FROM_IMU, np.array([0.1, -0.05, 0.02]))
RNG = np.random.default_rng(0)


def test_the_motion_comes_back_when_it_is_integrated():
    """Dead reckoning by the midpoint rule, over a second of a hand that shakes."""
    hand = true_motion.RecordedMotion(read_tum(data.path(data.HAND_MOTION)).part(slice(0, 300)))
    motion = simulated_imu.Shaken(hand, math.radians(0.3), 60.0, np.array([0.6, 0.0, 0.8]), 1.0)
    first = hand.intervals_ns[0][0]
    track = simulated_imu.simulate_imu(motion, PERFECT, LEVER, RNG)
    count = 2001
    start = motion.state(first, np.zeros(1))
    map_from_imu = Rotation.from_matrix(start.rotations[0] @ CAMERA_FROM_IMU)
    place = start.positions[0] + start.rotations[0] @ LEVER.position
    speed = start.rotations[0] @ (start.linear[0] + np.cross(start.angular[0], LEVER.position))
    gravity = np.array([0.0, 0.0, -9.80665])
    dt = 1.0 / PERFECT.rate
    for i in range(count - 1):
        rate = 0.5 * (track.angular_velocities[i] + track.angular_velocities[i + 1])
        halfway = map_from_imu * Rotation.from_rotvec(0.5 * dt * rate)
        force = 0.5 * (track.specific_forces[i] + track.specific_forces[i + 1])
        pull = halfway.apply(force) + gravity
        place, speed = place + dt * speed + 0.5 * dt**2 * pull, speed + dt * pull
        map_from_imu = map_from_imu * Rotation.from_rotvec(dt * rate)
    end = motion.state(int(track.times_ns[count - 1]), np.zeros(1))
    turned = Rotation.from_matrix(end.rotations[0] @ CAMERA_FROM_IMU)
    assert (turned.inv() * map_from_imu).magnitude() < math.radians(0.01)
    there = end.positions[0] + end.rotations[0] @ LEVER.position
    assert np.linalg.norm(place - there) < 1e-3
    assert np.linalg.norm(there - start.positions[0]) > 0.1  # it has been somewhere
