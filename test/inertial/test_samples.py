# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Readings in any order, repeated, lost, or by a clock that jumps: an exposure has its own."""

import random

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.reasons import ImuReason, Unused
from rs_localizer.inertial.gyro_prior import STANDARD_GRAVITY, gravity_seen
from rs_localizer.inertial.samples import MEMORY_NS, MOST, ImuSamples, SampleBuffer
from rs_localizer.inertial.turning import GyroscopeErrors

MS = 1_000_000
START = 1_700_000_000 * 10**9
PERIOD = 2_500_000  # 400 Hz


def stamps(count: int, period: int = PERIOD, start: int = START) -> list[int]:
    return [start + i * period for i in range(count)]


def filled(times: list[int]) -> SampleBuffer:
    """Each reading says when it was taken, in s since the start."""
    buffer = SampleBuffer()
    for time in times:
        seconds = (time - START) * 1e-9
        buffer.add(time, "imu", (seconds, 0.0, -seconds), (0.0, seconds, 9.8))
    return buffer


def lack(found: ImuSamples | Unused) -> ImuReason | None:
    return found.reason if isinstance(found, Unused) else None


def test_an_exposure_gets_its_readings_and_one_on_either_side():
    buffer = filled(stamps(400))
    start, end = START + 501 * MS, START + 531 * MS
    found = buffer.between(start, end)
    assert found.times_ns[0] <= start < found.times_ns[1]
    assert found.times_ns[-2] < end <= found.times_ns[-1]
    assert np.diff(found.times_ns).tolist() == [PERIOD] * (len(found.times_ns) - 1)
    seconds = (found.times_ns - START) * 1e-9
    np.testing.assert_allclose(found.angular_velocity[:, 0], seconds)
    np.testing.assert_allclose(found.specific_force[:, 1], seconds)
    # Ends that are stamps themselves need no more.
    exact = buffer.between(START + 500 * MS, START + 530 * MS)
    assert exact.times_ns[[0, -1]].tolist() == [START + 500 * MS, START + 530 * MS]
    assert buffer.rate() == pytest.approx(400.0)


def test_order_and_repetition_do_not_matter():
    times = stamps(400)
    mixed = [*times, *random.Random(0).sample(times, 50)]
    # Stragglers by up to 0.1 s.
    mixed = [t for _, t in sorted((t + random.Random(t).uniform(0, 1e8), t) for t in mixed)]
    buffer, ordered = filled(mixed), filled(times)
    assert len(buffer) == len(times)
    pair = [b.between(START + 401 * MS, START + 433 * MS) for b in (buffer, ordered)]
    assert pair[0].times_ns.tolist() == pair[1].times_ns.tolist()
    assert pair[0].angular_velocity.tolist() == pair[1].angular_velocity.tolist()


EVERY = stamps(400)  # until 997.5 ms


def without(first: float, last: float) -> list[int]:
    """All stamps but those between two times in ms."""
    return [time for time in EVERY if not first < (time - START) / MS < last]


@pytest.mark.parametrize(
    ("times", "first", "last", "reason", "said"),
    [
        ([], 0, 30, ImuReason.NEVER, ""),
        (EVERY, 980, 1010, ImuReason.LATE, "12.5 ms older than the last row"),
        (EVERY, 3000, 3030, ImuReason.STOPPED, "2.0 s older than the first row"),
        (EVERY, -1, 30, ImuReason.BEGINS_LATER, ""),
        (without(500, 520), 490, 525, ImuReason.GAP, "for 20.0 ms within"),
        (without(500, 520), 530, 560, None, ""),
        (without(500, 505), 490, 525, None, ""),  # one that is lost its neighbours tell
        (without(500, 507), 490, 525, ImuReason.GAP, ""),
        (stamps(50, 20 * MS), 100, 130, ImuReason.TOO_SLOW, ""),
        (stamps(100, 10 * MS), 100, 130, None, ""),
    ],
)
def test_what_is_missing_is_told(times, first, last, reason, said):
    found = filled(times).between(START + first * MS, START + last * MS)
    assert lack(found) == reason
    assert said in str(found)


def test_a_clock_that_is_set_back_starts_over():
    buffer = filled(stamps(400))
    buffer.add(START - 5 * 10**9, "imu", (0.0, 0.0, 0.0))
    assert len(buffer) == 1
    for time in stamps(100, start=START - 5 * 10**9 + PERIOD):
        buffer.add(time, "imu", (0.0, 0.0, 0.0))
    assert lack(buffer.between(START - 4900 * MS, START - 4870 * MS)) is None
    assert lack(buffer.between(START + 500 * MS, START + 530 * MS)) == ImuReason.STOPPED


def test_the_end_of_the_range_is_noticed():
    rng = np.random.default_rng(0)
    turn = 6.0 * np.sin(2.0 * np.pi * 3.0 * np.arange(400) * 2.5e-3)
    noisy = turn + 1e-3 * rng.normal(size=400)
    for limit, expected in ((4.36, ImuReason.SATURATED), (100.0, None)):
        buffer = SampleBuffer()
        for time, rate in zip(stamps(400), np.clip(noisy, -limit, limit).tolist(), strict=True):
            buffer.add(time, "imu", (0.0, rate, 0.0))
        # The peak of the sine lies at 1/12 s + k/3 s.
        found = buffer.between(START + 735 * MS, START + 765 * MS)
        assert lack(found) == expected
        # Also where readings are wanted that have not come.
        found = buffer.between(START + 735 * MS, START + 765 * MS, until_ns=START + 1500 * MS)
        assert lack(found) == expected
        # While it turns through zero, the gyroscope tells the truth.
        assert lack(buffer.between(START + 650 * MS, START + 680 * MS)) is None


def test_memory_is_bounded():
    times = stamps(20_000)
    buffer = filled(times)
    found = buffer.between(times[-20], times[-10], times[0])
    assert found.times_ns[0] == times[-1] - MEMORY_NS
    # So many that a second holds more than can be remembered, also all behind the newest.
    rush = SampleBuffer()
    for i in range(40_000):
        rush.add(START + 10_000 * i, "imu", (0.0, 0.0, 0.0))
        rush.add(START + 10_000 * i - 5_000, "imu", (0.0, 0.0, 0.0))
    assert MOST <= len(rush) <= 2 * MOST
    assert lack(rush.between(START + 399_000_000, START + 399_500_000)) is None


def test_times_that_repeat_are_refused():
    with pytest.raises(ValueError, match="must increase, got 7 ns after 7 ns"):
        ImuSamples(np.array([5, 7, 7, 9]), np.zeros((4, 3)))


ERRORS = GyroscopeErrors(np.zeros(10), 1e-8 * np.eye(10), 1e-4)
TIMES = 10**12 + np.arange(400) * 2_500_000


def test_gravity_of_a_camera_that_turns():
    rate = np.array([0.2, -0.5, 0.3])
    seconds = 1e-9 * (TIMES - TIMES[200])
    down = np.array([0.0, 0.6, 0.8])
    force = Rotation.from_rotvec(np.outer(seconds, rate)).inv().apply(-STANDARD_GRAVITY * down)
    samples = ImuSamples(TIMES, np.broadcast_to(rate, (400, 3)), force)
    found, deviation = gravity_seen(samples, int(TIMES[200]), ERRORS)
    np.testing.assert_allclose(found, down, atol=1e-5)
    assert deviation == pytest.approx(0.03, rel=1e-3)


def test_a_camera_that_accelerates_knows_gravity_less():
    seconds = 1e-9 * (TIMES - TIMES[200])
    still = np.broadcast_to([0.0, -STANDARD_GRAVITY, 0.0], (400, 3))
    pushed = still + np.outer(np.sin(2.0 * np.pi * 3.0 * seconds), [3.0, 0.0, 0.0])
    rates = np.zeros((400, 3))
    calm, pushed, falling, without = (
        gravity_seen(ImuSamples(TIMES, rates, *force), int(TIMES[200]), ERRORS)
        for force in ([still], [pushed], [0.1 * still], [])
    )
    direction, deviation = pushed
    assert deviation > 3.0 * calm[1]
    assert np.arccos(min(direction @ [0.0, 1.0, 0.0], 1.0)) < 2.0 * deviation
    assert falling is None
    assert without is None
