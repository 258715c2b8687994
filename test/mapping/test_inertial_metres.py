# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scale and gravity of a map by an IMU: found, refused with a reason, compared with markers."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from felt import GRAVITY, Felt
from scenes import SECONDS, START_NS, camera, hand, imu_of, refined_of, walk

from rs_localizer.mapping import MappingError
from rs_localizer.mapping.anchors import Placement
from rs_localizer.mapping.gauge import Similarity
from rs_localizer.mapping.inertial_metres import GivenImu, NoMetres, inertial_metres, place_by_imu
from rs_localizer.mapping.refine import RefinedMap, refine
from rs_localizer.trajectory.imu import ImuRecording

NOTHING = Placement(Similarity(1.0, np.eye(3), np.zeros(3)), False, False, "nothing")


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """deg."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)))


@pytest.fixture(scope="module")
def felt() -> Felt:
    return Felt.random(7)


@pytest.fixture(scope="module")
def imu(felt) -> ImuRecording:
    return imu_of(felt)


@pytest.fixture(scope="module")
def refined(felt) -> RefinedMap:
    return refined_of(felt)


def test_the_frame_is_in_metres_and_upright(felt, refined, imu):
    """The IMU turned, off the camera, biased by 0.3 m/s^2, its stamps off by 5 ms."""
    place = place_by_imu(NOTHING, refined, GivenImu(imu, asked=True))
    assert place.placement.scaled
    assert place.placement.levelled
    assert "the IMU, to 0." in place.placement.basis
    similarity = place.placement.similarity
    assert similarity.scale == pytest.approx(felt.scale, rel=5e-3)
    assert angle(similarity.rotation @ felt.down, np.array([0.0, 0.0, -1.0])) < 0.1
    first = refined.poses()[1][:1]
    np.testing.assert_allclose(similarity(first), np.zeros((1, 3)), atol=1e-9)
    assert place.time_offset == pytest.approx(felt.delay, abs=3e-4)
    assert place.metres.share < 0.01
    assert place.doubts == ()


@pytest.mark.parametrize(("wrong", "said"), [(1.0, ()), (1.08, ("7.", "smaller"))])
def test_markers_are_checked(felt, refined, imu, wrong, said):
    """Sizes of markers that are given 8 % too large."""
    by_markers = Similarity(wrong * felt.scale, felt.map_from_world.as_matrix().T, np.ones(3))
    given = Placement(by_markers, True, True, "markers", up="as in the marker map")
    place = place_by_imu(given, refined, GivenImu(imu, asked=False))
    assert place.placement is given
    assert place.larger == pytest.approx(1.0 / wrong - 1.0, abs=6e-3)
    assert np.degrees(place.tilt) < 0.1
    assert bool(place.doubts) == bool(said)
    for word in said:
        assert word in place.doubts[0]


def test_a_distance_gives_the_scale_and_the_imu_what_is_up(felt, refined, imu):
    given = replace(NOTHING, similarity=Similarity(0.36, np.eye(3), np.zeros(3)), scaled=True)
    place = place_by_imu(given, refined, GivenImu(imu, asked=False))
    assert place.placement.similarity.scale == 0.36
    assert place.placement.levelled
    assert np.degrees(place.tilt) < 0.1


def test_tf_is_checked_and_not_believed(felt, refined, imu):
    right = felt.camera_from_imu.as_matrix()
    assert inertial_metres(refined, replace(imu, camera_from_imu=right)).doubts == ()
    turned = replace(imu, camera_from_imu=right @ np.diag([1.0, -1.0, -1.0]))
    found = inertial_metres(refined, turned)
    assert "180.0 deg off" in found.doubts[0]
    assert found.metric.scale == pytest.approx(felt.scale, rel=5e-3)


def test_where_turns_do_not_tell_the_rotation_tf_does():
    """About one axis alone."""
    felt = Felt.random(10, turn=np.array([0.2, 0.0, 0.0]))
    refined, imu = refined_of(felt), imu_of(felt)
    with pytest.raises(NoMetres, match="turn the camera about all axes"):
        inertial_metres(refined, imu)
    given = replace(imu, camera_from_imu=felt.camera_from_imu.as_matrix())
    found = inertial_metres(refined, given)
    assert found.metric.scale == pytest.approx(felt.scale, rel=0.01)
    assert angle(found.metric.gravity, felt.down) < 0.3


def forces_by(imu: ImuRecording, change: Callable[[np.ndarray], np.ndarray]) -> ImuRecording:
    return replace(imu, specific_forces=change(imu.specific_forces))


def without_gravity(imu: ImuRecording, felt: Felt) -> ImuRecording:
    axes = (felt.world(felt.stamps(SECONDS) + felt.delay)[0] * felt.camera_from_imu).inv()
    return forces_by(imu, lambda forces: forces - axes.apply([0.0, 0.0, GRAVITY]))


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        (lambda imu, _: replace(imu, specific_forces=None), "has no accelerometer"),
        (
            lambda imu, _: replace(imu, stamps_ns=imu.stamps_ns - START_NS),
            r"its stamps are -0.600 to 6.59\d s, those of the images .* one clock",
        ),
        (
            lambda imu, _: forces_by(imu, lambda forces: forces / GRAVITY),
            "long, gravity is 9.81 m.s.2: it seems to count in g",
        ),
        (
            lambda imu, _: forces_by(imu, lambda forces: -forces),  # as a phone may show it
            "at rest it must show .g upwards",
        ),
        (
            lambda imu, _: forces_by(imu, lambda forces: forces[:, [1, 2, 0]]),
            "other axes than those of the gyroscope|accelerations",
        ),
        (
            lambda imu, _: replace(imu, angular_velocities=np.degrees(imu.angular_velocities)),
            "are they in rad/s",
        ),
        (without_gravity, "gravity seems to have been taken off"),
    ],
)
def test_what_is_wrong_is_said(felt, refined, imu, spoilt, said):
    place = place_by_imu(NOTHING, refined, GivenImu(spoilt(imu, felt), asked=False))
    assert place.placement is NOTHING
    assert place.metres is None
    (doubt,) = place.doubts
    assert doubt.startswith("the IMU gives no scale: ")
    assert re.search(said, doubt)


def test_a_camera_that_only_turns_determines_no_size():
    felt = Felt.random(8, way=5e-4, lever=(0.0, 0.0, 0.0))
    refined, imu = refined_of(felt), imu_of(felt)
    rng = np.random.default_rng(0)
    spline = refined.spline
    step = rng.normal(0.0, 0.01, (len(spline.positions), 3))
    noisy = replace(refined, spline=replace(spline, positions=spline.positions + step))
    with pytest.raises(MappingError, match=r"the IMU gives no scale: .*to and fro"):
        place_by_imu(NOTHING, noisy, GivenImu(imu, asked=True))
    place = place_by_imu(NOTHING, noisy, GivenImu(imu, asked=False))
    assert not place.placement.scaled


def test_of_images_with_a_rolling_shutter():
    """From keypoints of a map that is off by 2 cm, and 2.3 times too large."""
    rng = np.random.default_rng(11)
    state = rng.bit_generator.state
    motion = hand(rng)
    rng.bit_generator.state = state
    stamps = np.arange(0.0, 4.0, 1 / 15)
    seen = walk(rng, stamps, points=80, count=30)
    start = replace(
        seen.start, points=2.3 * seen.start.points, positions=2.3 * seen.start.positions
    )
    refined = refine(camera(), seen.seen, start)
    times = np.arange(-0.6, 4.6, 0.0025)

    def place(t: np.ndarray) -> np.ndarray:
        return motion.pose(t)[1]

    h = 1e-3
    acceleration = (place(times + h) - 2.0 * place(times) + place(times - h)) / h**2
    down = np.array([0.3, 0.9, 0.1]) / np.linalg.norm([0.3, 0.9, 0.1])
    axes, _ = motion.pose(times)
    forces = np.einsum("nji,nj->ni", axes, acceleration - GRAVITY * down)
    noise = rng.normal(0.0, 1.0, (2, *forces.shape))
    imu = ImuRecording(
        10**12 + np.round(1e9 * (times - 0.004)).astype(np.int64),
        motion.twist(times)[0] + 3e-3 * noise[0],
        np.eye(3),
        forces + 0.03 * noise[1] + [0.1, -0.1, 0.2],
    )
    found = inertial_metres(refined, imu)
    assert found.share < 0.03
    assert 2.3 * found.metric.scale == pytest.approx(1.0, abs=4.0 * found.share)
    assert angle(found.metric.gravity, down) < 0.6
    assert found.mount.mount.delay == pytest.approx(0.004, abs=1e-3)
