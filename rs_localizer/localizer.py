"""The method: from 2D-3D correspondences of one frame to a pose and its velocities."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import LocalizerConfig, localizer_config
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import ANGULAR
from rs_localizer.core.steadied import steadied
from rs_localizer.core.types import Estimate, Failure, Reason
from rs_localizer.estimation.acceptance import refusal
from rs_localizer.estimation.delay import delay_of
from rs_localizer.estimation.inputs import checked, distinct, median_point, near_image, unfit
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.prior import (
    Prior,
    PriorTerms,
    held_terms,
    motion_terms,
    state_in,
    with_measurements,
    with_motion,
    with_turn,
)
from rs_localizer.estimation.ransac import Candidate
from rs_localizer.estimation.refine import step_between
from rs_localizer.estimation.sampling import generator
from rs_localizer.estimation.searching import Frame, MotionSearch
from rs_localizer.estimation.settling import FIELD_SIZES, SHAKE_SIZES, Assumed, TurnSeen, settle
from rs_localizer.solvers.table import Solver, find_solver

# A prediction may be off by this multiple of the inlier threshold.
_PREDICTION_SCALE = 16.0
# Squared Mahalanobis distance of a prediction; a chi-squared variable of 18 degrees of freedom
# exceeds this once in a million.
_MOST_INNOVATION = 62.0
# Points that agree with a prediction's optimum, as a share of those that agreed before.
_STILL_TRACKED = 0.7
# Where the readout time is unknown, that of a slow camera: its motion per readout is the largest.
_UNKNOWN_READOUT_TIME = 0.03
# Accelerations change at the pace of two hertz, rad/s.
_JERK_RATE = 4.0 * math.pi
# Third derivative of the cubic among the polynomials of the shaking.
_JERK_OF_CUBIC = 120.0
# Points farther away than this (m) are faults, and their squares would be infinite.
_FARTHEST_POINT = 1e9


class Localizer:
    """Rolling-shutter absolute pose of single frames.

    Args:
        camera: calibrated camera with its shutter.
        config: all settings, or give single ones as keywords (see :class:`LocalizerConfig`).

    Raises:
        ValueError: a setting is unknown, out of range, or names a solver that is not available.
    """

    def __init__(
        self, camera: Camera, config: LocalizerConfig | None = None, **settings: object
    ) -> None:
        if not isinstance(camera, Camera):
            raise ValueError(f"camera must be an rs_localizer.Camera, got {type(camera).__name__}")
        if config is not None and settings:
            raise ValueError(f"give either config or settings, got both: {', '.join(settings)}")
        self.config = config or localizer_config(settings)
        self.camera = camera
        self._solver = find_solver(self.config.solver)
        self._search = MotionSearch(camera, self.config, self._solver)
        self._terms, self._assumed = assumptions(camera, self.config, self._solver)

    def warm_up(self) -> None:
        """Compile every kernel that :meth:`localize` may need, or load it from the cache."""
        # A still camera before a scene that is no plane; with half a prediction, which is dropped.
        count = max(60, self.config.min_inliers)
        pixels = np.random.default_rng(0).uniform(0.3, 0.7, (count, 2)) * self.camera.size
        rays = np.nan_to_num(self.camera.rays(pixels))
        depth = 2.0 + np.arange(count) % 3
        points = depth[:, None] * np.column_stack([rays, np.ones(count)])
        still = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        prior = Prior(motion=still, covariance=1e-4 * np.eye(18), gravity=(0.0, 0.0, 1.0),
                      gravity_deviation=1.0, gravity_in_map=(0.0, 0.0, 1.0))  # fmt: skip
        self.localize(points, pixels, np.arange(count, dtype=np.float64), prior)
        self.localize(points, pixels)
        # And with one that shakes, rows to and fro.
        swing = 2.0 * self.config.inlier_threshold * np.sin(12.0 * self.camera.row_time(pixels))
        self.localize(points, pixels + np.outer(swing, self.camera.row_time_gradient[::-1] != 0.0))
        # And beside the turn that a gyroscope knows, of which the delay is in doubt.
        tau = np.linspace(-0.7, 0.7, 29)
        rates = 0.1 * np.column_stack([np.sin(20.0 * tau)] * 3)
        self.localize(points, pixels, turn=KnownTurn.of(tau, rates, 1e-4 * np.eye(6), delay=0.01))

    def localize(
        self,
        points: ArrayLike,
        pixels: ArrayLike,
        scores: ArrayLike | None = None,
        prior: Prior | None = None,
        expected_share: float = 0.5,
        turn: KnownTurn | None = None,
    ) -> Estimate | Failure:
        """Estimate pose and velocities from one frame.

        Args:
            points: (n,3) in the map frame, metres.
            pixels: (n,2) raw image coordinates, first pixel centre at 0, 0.
            scores: (n,) quality of the matches, higher is better.
            prior: what else is known of the motion. A prior motion is also a first guess; if the
                points do not agree with it, it is dropped and the whole search runs.
            expected_share: share of inliers among the points that a prior motion should find.
            turn: how the camera turned during the readout, as a gyroscope knows it. A prior
                motion is then the one beside it.

        Returns:
            an :class:`Estimate`, or a :class:`Failure` with its reason. Same seed and same input
            give the same result.

        Raises:
            ValueError: wrong shapes, or values that are not finite.
        """
        if prior is not None and not isinstance(prior, Prior):
            raise ValueError(f"prior must be an rs_localizer.Prior, got {type(prior).__name__}")
        points, pixels, scores = checked(points, pixels, scores)
        if not 0.0 <= expected_share <= 1.0:
            raise ValueError(f"expected_share must lie between 0 and 1, got {expected_share}")
        rays, by_ray = self.camera.rays_and_jacobian(pixels)
        if turn is not None:
            gradient = self.camera.row_time_gradient
            rays, by_ray = steadied(rays, self.camera.row_time(pixels), by_ray, gradient, turn)
        seen = np.isfinite(rays[:, 0])
        centre = median_point(points, seen)
        with np.errstate(over="ignore"):
            within = np.abs(points - centre).max(axis=1, initial=0.0) < _FARTHEST_POINT
        shown = near_image(self.camera, pixels)
        usable = distinct(points, pixels, np.flatnonzero(seen & within & shown))
        failure = unfit(self.camera, pixels, usable, shown, self.config.min_inliers)
        if failure is not None:
            return failure
        frame = self._frame(points, pixels, rays, by_ray, usable, centre, scores, prior, turn)
        if prior is not None and prior.motion is not None:
            tracked = self._track(frame, prior, expected_share)
            if tracked:
                return replace(tracked, tracked=True)
        start, best = self._search.find(frame)
        if not start.found:
            return Failure(Reason.NO_HYPOTHESIS, "no three points gave a pose")
        return self._accept(frame, start, best, self._final(frame, best, frame.terms))

    # -- steps ------------------------------------------------------------------------------

    def _frame(
        self,
        points: Array,
        pixels: Array,
        rays: Array,
        by_ray: Array,
        usable: IntArray,
        centre: Array,
        scores: Array | None,
        prior: Prior | None,
        turn: KnownTurn | None,
    ) -> Frame:
        terms = self._terms if turn is None else with_turn(self._terms, turn.error)
        observations = Observations.of(
            points[usable] - centre,
            rays[usable],
            self.camera.row_time(pixels[usable]),
            by_ray[usable],
            self.camera.row_time_gradient,
        )
        return Frame(
            observations,
            usable,
            len(points),
            centre,
            None if scores is None else np.argsort(-scores[usable], kind="stable"),
            terms if prior is None else with_measurements(terms, prior),
            generator(self.config.seed),
            _with_experience(self._assumed, prior, self._turn_seen(turn)),
            turn,
        )

    def _turn_seen(self, turn: KnownTurn | None) -> TurnSeen | None:
        if turn is None:
            return None
        variance = float(np.trace(turn.error[:3, :3])) / 3.0 + turn.rate_noise**2
        precision = float(self._terms.informations[0][ANGULAR, ANGULAR][0, 0])
        typical = 1.0 / precision if precision > 0.0 else math.inf
        return TurnSeen(float(turn.rate @ turn.rate), variance, typical)

    def _track(self, frame: Frame, prior: Prior, expected_share: float) -> Estimate | Failure:
        """The motion nearest to the prior one, if the points agree with it."""
        assert prior.motion is not None
        threshold = self.config.inlier_threshold
        predicted = state_in(prior.motion, frame.centre)
        terms = with_motion(frame.terms, prior, frame.centre, frame.turn is not None)
        best = self._search.optimize(frame, predicted, _PREDICTION_SCALE * threshold, terms)
        start = Candidate(predicted, best.cost)
        posterior = self._final(frame, best, terms)
        innovation = step_between(predicted, posterior.state)
        if innovation @ terms.informations[-1] @ innovation > _MOST_INNOVATION:
            posterior = self._final(frame, best, frame.terms)  # a jump: the points know better
        result = self._accept(frame, start, best, posterior)
        if result and np.count_nonzero(result.inliers) < (
            _STILL_TRACKED * expected_share * len(frame.usable)
        ):
            return Failure(
                Reason.TOO_FEW_INLIERS,
                f"{np.count_nonzero(result.inliers)} inliers near the prior motion, "
                f"{expected_share:.0%} of {len(frame.usable)} were expected",
            )
        return result

    def _final(self, frame: Frame, best: Candidate, terms: PriorTerms) -> Posterior:
        # Unless more is known of this very frame than the prior of the configuration.
        may_rest = self._assumed.may_rest and len(terms.informations) == 1
        assumed = replace(frame.assumed, may_rest=may_rest)
        threshold = self.config.inlier_threshold
        return settle(frame.observations, best.state, terms, threshold, assumed)

    def _accept(
        self, frame: Frame, start: Candidate, best: Candidate, posterior: Posterior
    ) -> Estimate | Failure:
        """Accept the motion or say what is wrong with it."""
        failure = refusal(
            frame.observations,
            posterior,
            best.samples,
            min_inliers=self.config.min_inliers,
            threshold=self.config.inlier_threshold,
            rolling=self._solver.rolling_shutter,
        )
        # Not `or`: a Failure is false.
        return self._estimate(frame, start, best, posterior) if failure is None else failure

    def _estimate(
        self, frame: Frame, start: Candidate, best: Candidate, posterior: Posterior
    ) -> Estimate:
        state, turn = posterior.state, frame.turn
        rotation = state[:9].reshape(3, 3)
        residuals = np.full(frame.count, np.nan)
        residuals[frame.usable] = np.sqrt(posterior.squared_errors)
        inliers = np.zeros(frame.count, dtype=np.bool_)
        inliers[frame.usable] = posterior.inliers
        found = Estimate(
            rotation=rotation,
            translation=state[9:12] - rotation @ frame.centre,
            angular_velocity=state[12:15],
            linear_velocity=state[15:18],
            angular_acceleration=state[18:21],
            linear_acceleration=state[21:24],
            inliers=inliers,
            residuals=residuals,
            joint_covariance=posterior.covariance,
            shake=posterior.shake,
            model_error=posterior.model_error,
            of_shake_sizes=posterior.of_shake_sizes,
            of_field_sizes=posterior.of_field_sizes,
            global_shutter_inliers=self._search.global_shutter_inliers(frame, start),
            iterations=best.samples,
        )
        return (
            found
            if turn is None
            else found.turned(turn, delay_of(frame.observations, posterior, turn))
        )


def assumptions(
    camera: Camera, config: LocalizerConfig, solver: Solver
) -> tuple[PriorTerms, Assumed]:
    """What the configuration assumes of motion, camera and map, per readout."""
    readout_time = camera.readout_time or _UNKNOWN_READOUT_TIME
    velocity, acceleration = config.velocity_prior, config.acceleration
    terms = (
        motion_terms(
            (velocity.angular * readout_time, velocity.linear * readout_time),
            (acceleration.angular * readout_time**2, acceleration.linear * readout_time**2),
        )
        if solver.rolling_shutter
        else held_terms()
    )
    jerk = acceleration.angular * _JERK_RATE * readout_time**3
    return terms, Assumed(
        shake=jerk / _JERK_OF_CUBIC,
        map_deviation=config.map_deviation,
        focal_length=camera.focal_length,
        of_shake_sizes=np.zeros(SHAKE_SIZES),
        of_field_sizes=np.zeros(FIELD_SIZES),
        may_rest=solver.rolling_shutter and min(velocity.angular, velocity.linear) > 0.0,
        rolling=solver.rolling_shutter,
    )


def _with_experience(assumed: Assumed, prior: Prior | None, turn: TurnSeen | None) -> Assumed:
    """The assumptions and what gyroscope and earlier frames say of turn, shaking, model error."""
    if turn is not None:
        assumed = replace(assumed, turn=turn)
    if prior is None or prior.of_shake_sizes is None or prior.of_field_sizes is None:
        return assumed
    return replace(
        assumed, of_shake_sizes=prior.of_shake_sizes, of_field_sizes=prior.of_field_sizes
    )
