# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a filter downstream may be fed with: ``python -m benchmarks.fusion``.

Simulated flights through the localizer, with and without tracking, and its poses and twists through
the filter of robot_localization (:mod:`benchmarks.ekf`). A filter takes the errors
of its measurements for independent. They are not where tracking has used the last frames already,
nor where pose and twist are of the same image: then the filter is surer than it should be, which
its squared error in standard deviations (NEES) shows. It is 6 for a pose when all is right. And it
takes covariances of orientations for those of roll, pitch and yaw (``orientation_covariance``).
"""

from __future__ import annotations

import argparse
import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from benchmarks.ekf import Ekf, nees
from benchmarks.honesty.estimating import believed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import PERIOD_NS, Frames, simulate
from benchmarks.independent.motions import Motions, States, hand
from benchmarks.independent.scenes import Rich
from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Pose, Twist
from rs_localizer.io.transforms import Transform
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.pipeline.published import Mounting, about_angles, base_pose, base_twist
from rs_localizer.tracking import Tracker

NOISE = 1.0  # px
SETTLED = 30  # frames that do not count
_SLOWER = 2.0  # than a hand: 33 deg/s, 1.5 m/s^2
# The camera looks forward on a body with x forward, y left, z up.
_BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MOUNTING = Mounting(
    Transform(_BODY_FROM_CAMERA.T, np.array([0.05, 0.1, -0.2])), np.zeros(3), np.zeros(3)
)
# Process noise per second, as one tunes it for this flight: of accelerations and turn rates that
# are others after a fifth of a second, and of what they change within 1/30 s.
_ACCELERATIONS, _RATES = 8.0, 1.6
_PROCESS_NOISE = np.repeat([1e-6, 1e-4, 1e-3, _RATES, _ACCELERATIONS], 3)
_FIRST = ((0.5, 0.7), 2.0)  # deviations of the first velocities and acceleration


@dataclass(frozen=True, slots=True)
class Choice:
    """What the filter gets."""

    name: str
    tracking: bool
    pose: bool = True
    twist: str = ""  # or angular, all
    angles: bool = True  # covariances about roll, pitch and yaw, not about fixed axes


CHOICES = (
    Choice("pose about fixed axes, tracking off", False, angles=False),
    Choice("pose, tracking off", False),
    Choice("pose and turn rate, tracking off", False, twist="angular"),
    Choice("pose and twist, tracking off", False, twist="all"),
    Choice("pose, tracking on", True),
    Choice("pose and turn rate, tracking on", True, twist="angular"),
    Choice("pose and twist, tracking on", True, twist="all"),
    Choice("twist, tracking on", True, pose=False, twist="all"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """Of n flights of m settled frames each."""

    pose: Array  # (n,m) NEES of position and angles
    velocity: Array  # (n,m) NEES of both velocities
    position: float  # m, rms

    @property
    def band(self) -> tuple[float, float]:
        """Where 95 % of the means over all flights belong, of six degrees of freedom."""
        count = len(self.pose)
        low, high = chi2.ppf([0.025, 0.975], 6 * count) / count
        return float(low), float(high)

    @property
    def inside(self) -> float:
        """The share of moments in which the poses' mean over all flights is in the band."""
        low, high = self.band
        means = self.pose.mean(axis=0)
        return float(np.mean((means >= low) & (means <= high)))


Outputs = list[list[tuple[Pose, Twist] | None]]


def fly(flights: int, length: int, seed: int) -> Frames:
    """Flights of a level body, seen by its camera."""
    return simulate(Camera(), _level, Rich(), flights, length, seed)


def _level(count: int, rng: np.random.Generator) -> Motions:
    yaw = rng.uniform(-math.pi, math.pi, count)
    rotations = np.zeros((count, 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
    rotations[:, 1, 0], rotations[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    rotations[:, 2, 2] = 1.0
    return replace(hand(count, rng, _SLOWER), rotation=rotations @ _BODY_FROM_CAMERA)


def outputs(frames: Frames, tracking: bool) -> Outputs:
    """What the node would publish of the body, by flight and frame; None: no pose."""
    localizer = Localizer(believed(frames.camera))
    tracker = Tracker(localizer)
    found: Outputs = [[] for _ in range(int(frames.recording.max()) + 1)]
    for frame in range(len(frames)):
        if frames.place[frame] == 0:
            tracker.reset()
        seen = frames.seen(frame, NOISE)
        localize = functools.partial(tracker.localize, frames.middle_ns(frame))
        estimate = localize(*seen) if tracking else localizer.localize(*seen)
        found[frames.recording[frame]].append(
            (
                base_pose(pose_at(estimate, 0.0), MOUNTING),
                base_twist(twist_at(estimate, 0.0, frames.camera.readout_time), MOUNTING),
            )
            if estimate
            else None
        )
    return found


def fuse(frames: Frames, published: Outputs, choice: Choice) -> Fused:
    """The filter's estimates of all flights against the truth."""
    truth = true_states(frames.middle)
    length = len(published[0])
    of_pose, of_velocity, squares = [], [], []
    for flight, messages in enumerate(published):
        first, begin = _first_pose(messages)
        ekf = Ekf(_PROCESS_NOISE, about_angles(begin), *_FIRST)
        for index in range(first + 1, length):
            ekf.predict(PERIOD_NS * 1e-9)
            _correct(ekf, messages[index], choice)
            if index < SETTLED:
                continue
            error = ekf.error(*(values[flight * length + index] for values in truth))
            of_pose.append(nees(error[:6], ekf.covariance[:6, :6]))
            of_velocity.append(nees(error[6:], ekf.covariance[6:12, 6:12]))
            squares.append(error[:3] @ error[:3])
    shape = (len(published), -1)
    rms = float(np.sqrt(np.mean(squares)))
    return Fused(np.reshape(of_pose, shape), np.reshape(of_velocity, shape), rms)


def _first_pose(messages: list[tuple[Pose, Twist] | None]) -> tuple[int, Pose]:
    for index, message in enumerate(messages):
        if message is not None:
            return index, message[0]
    raise ValueError("a flight has no pose at all")


def _correct(ekf: Ekf, message: tuple[Pose, Twist] | None, choice: Choice) -> None:
    if message is None:
        return
    pose, twist = message
    if choice.pose:
        ekf.correct_pose(about_angles(pose) if choice.angles else pose)
    if choice.twist:
        ekf.correct_twist(twist, linear=choice.twist == "all")


def true_states(camera: States) -> tuple[Array, Array, Array, Array]:
    """Position, rotation, linear and angular velocity of the body, from those of its camera."""
    lever = MOUNTING.camera_from_base.translation
    linear = camera.linear + np.cross(camera.angular, lever)
    return (
        camera.position + camera.rotation @ lever,
        camera.rotation @ _BODY_FROM_CAMERA.T,
        linear @ _BODY_FROM_CAMERA.T,
        camera.angular @ _BODY_FROM_CAMERA.T,
    )


def main(arguments: list[str] | None = None) -> None:
    """Print a table of all choices."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fusion", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    frames = fly(options.flights, options.frames, options.seed)
    published = {tracking: outputs(frames, tracking) for tracking in (False, True)}
    print(f"{'the filter gets':36} {'NEES pose':>9} {'inside':>7} {'velocity':>9} {'mm':>6}")
    for choice in CHOICES:
        fused = fuse(frames, published[choice.tracking], choice)
        print(
            f"{choice.name:36} {fused.pose.mean():9.2f} {fused.inside:7.0%} "
            f"{fused.velocity.mean():9.2f} {1e3 * fused.position:6.2f}"
        )
    low, high = fused.band
    print(f"95 % of the moments' means belong between {low:.2f} and {high:.2f}")


if __name__ == "__main__":
    main()
