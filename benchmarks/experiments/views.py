# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Single frames for the Localizer, and how far its estimates are from the truth in sigmas."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.experiments.kernels import informations
from benchmarks.experiments.methods import states
from benchmarks.experiments.trials import Setting, camera, draw_trials
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Mounts
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import (
    MOTION_PARAMETERS,
    STATE_ANGULAR,
    STATE_LINEAR,
    STATE_TRANSLATION,
    rotation_of,
    step_between,
)
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import state_in

POSE = slice(0, 6)
VELOCITIES = slice(6, 12)
# An estimate farther than this from the truth, in standard deviations of the bound, is wrong.
GROSS = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a camera sees, with and without its noise, and the truth."""

    camera: Camera
    points: Array  # (n,3)
    pixels: Array  # (n,2) with noise and outliers
    true_pixels: Array  # (n,2)
    inliers: BoolArray  # (n,)
    motion: Motion
    noise: float  # px

    def information(self) -> Array:
        """Fisher information (12,12) of the true inliers, without noise, at the true motion."""
        points, pixels = self.points[self.inliers], self.true_pixels[self.inliers]
        rays = self.camera.rays(pixels)
        centre = self.points.mean(axis=0)
        found: Array = informations(
            state_in(self.motion, centre)[None], (points - centre)[None], rays[None],
            self.camera.row_time(pixels)[None], self.camera.pixel_jacobian(rays),
            Mounts.one(self.camera.row_time_gradient),
        )[0]  # fmt: skip
        return found / self.noise**2

    def off(self, found: Motion) -> Array:
        """The step (12,) from an estimate to the truth, in the order of its covariance."""
        centre = self.points.mean(axis=0)
        step = step_between(state_in(found, centre), state_in(self.motion, centre))
        return step[:MOTION_PARAMETERS]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Squared errors of one frame; infinite where there was no pose."""

    bound: float  # in the metric of the bound
    pose_bound: float  # pose alone, in that of a camera known to be at rest
    reported: float  # in the metric of the reported covariance
    reported_pose: float  # the same of its pose block
    reported_velocities: float

    @property
    def localized(self) -> bool:
        return bool(np.isfinite(self.bound))

    @property
    def gross(self) -> bool:
        """Published, and wrong."""
        return self.localized and self.bound > GROSS**2


NO_POSE = Outcome(*[np.inf] * 5)


def outcome(view: View, result: Estimate | Failure) -> Outcome:
    """How far a result is from the truth."""
    if not result:
        return NO_POSE
    step, information, covariance = view.off(result), view.information(), result.covariance

    def reported(part: slice) -> float:
        return float(step[part] @ np.linalg.solve(covariance[part, part], step[part]))

    return Outcome(
        float(step @ information @ step),
        float(step[POSE] @ information[POSE, POSE] @ step[POSE]),
        reported(slice(0, 12)),
        reported(POSE),
        reported(VELOCITIES),
    )


def synthetic_views(
    count: int, seed: int, setting: Setting, outliers: float = 0.0
) -> Iterator[View]:
    """Frames of the synthetic scene, part of whose pixels are uniform in the image."""
    view = camera()
    # The same frames with and without noise: the noise is drawn in either case.
    noisy = draw_trials(count, seed, setting)
    exact = draw_trials(count, seed, replace(setting, noise=0.0))
    rng = np.random.default_rng([seed, 3])
    wrong = round(outliers * setting.points)
    for i, state in enumerate(states(noisy.truth)):
        pixels, true_pixels = (
            np.ascontiguousarray(x.rays[i] * view.K[0, 0] + view.K[:2, 2]) for x in (noisy, exact)
        )
        inliers = np.ones(setting.points, dtype=np.bool_)
        inliers[rng.permutation(setting.points)[:wrong]] = False
        pixels[~inliers] = uniform_pixels(view, wrong, rng)
        motion = Motion(
            rotation_of(state), state[STATE_TRANSLATION], state[STATE_ANGULAR], state[STATE_LINEAR]
        )
        yield View(view, np.ascontiguousarray(noisy.points[i]), pixels, true_pixels, inliers,
                   motion, setting.noise)  # fmt: skip


def uniform_pixels(view: Camera, count: int, rng: np.random.Generator) -> Array:
    """Pixels (count,2) anywhere in the image."""
    return rng.uniform(-0.5, np.array(view.size) - 0.5, (count, 2))


def seen_at(motion: Motion, view: Camera, pixels: Array, depth: Array) -> Array:
    """Points (n,3) in the map that are seen at pixels (n,2), each at the time of its row."""
    rotations, translations = motion.at_rows(view.row_time(pixels))
    local = depth[:, None] * np.column_stack([view.rays(pixels), np.ones(len(pixels))])
    points: Array = np.einsum("nji,nj->ni", rotations, local - translations)
    return points


def direction(rng: np.random.Generator) -> Array:
    """Any unit vector (3,)."""
    vector = rng.normal(size=3)
    unit: Array = vector / np.linalg.norm(vector)
    return unit
