"""The method: from 2D-3D correspondences of one frame to a pose and its velocities."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.acceptance import determines_motion, refusal
from rs_localizer.core.camera import Camera
from rs_localizer.core.inputs import checked, median_point
from rs_localizer.core.posterior import (
    WIDEST_GATE,
    Posterior,
    maximum_a_posteriori,
    weigh_against_rest,
)
from rs_localizer.core.prior import (
    Prior,
    PriorTerms,
    held_terms,
    state_in,
    velocity_terms,
    with_prior,
)
from rs_localizer.core.ransac import NOTHING, Candidate, Hypotheses, Observations, search
from rs_localizer.core.refine import step_between
from rs_localizer.core.sampling import IntArray, Pool, Random, generator
from rs_localizer.core.scoring import optimize
from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import BoolArray, Estimate, Failure, Reason
from rs_localizer.solvers import Solver, find_solver

# A global-shutter pose under motion misses the points of the first and last rows by a good part
# of the image; it only has to be right to some degrees. In focal lengths.
_GLOBAL_SHUTTER_SCALE = 0.05
_POOL_SCALE = 0.12
# Minimal models are scored at this multiple of the inlier threshold: noise makes a six-point
# model miss the other inliers by several times their own noise.
_SCORE_SCALE = 4.0
# A prediction may be off by this multiple of the inlier threshold.
_PREDICTION_SCALE = 16.0
# Squared Mahalanobis distance of a prediction; a chi-squared variable of 12 degrees of freedom
# exceeds this once in a million.
_MOST_INNOVATION = 51.0
# Points that agree with a prediction's optimum, as a share of those that agreed before.
_STILL_TRACKED = 0.7
_GLOBAL_SHUTTER_BLOCK = 48
_BLOCK = 64
_GLOBAL_SHUTTER_MOST_SAMPLES = 384
# Enough to find three inliers among points of which two fifths are.
_SECOND_LOOK_SAMPLES = 96
# Points farther away than this (m) are faults, and their squares would be infinite.
_FARTHEST_POINT = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """One frame on its way through the steps."""

    observations: Observations
    usable: IntArray  # which of the given points are observed
    count: int  # of the given points
    centre: Array  # (3,) map frame: origin of the observed points
    ranking: IntArray | None  # observed points from the best to the worst
    terms: PriorTerms  # velocity prior and whatever else is known but the pose
    random: Random


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
        if config is not None and settings:
            raise ValueError(f"give either config or settings, got both: {', '.join(settings)}")
        try:
            self.config = config or LocalizerConfig(**settings)  # type: ignore[arg-type]
        except TypeError as error:
            raise ValueError(f"unknown setting: {error}") from None
        self.camera = camera
        self._solver = find_solver(self.config.solver)

    def warm_up(self) -> None:
        """Compile every kernel that :meth:`localize` may need, or load it from the cache."""
        # A still camera before a scene that is no plane; with half a prediction, which is dropped.
        count = max(25, self.config.min_inliers)
        pixels = np.random.default_rng(0).uniform(0.3, 0.7, (count, 2)) * self.camera.size
        rays = np.nan_to_num(self.camera.rays(pixels))
        depth = 2.0 + np.arange(count) % 3
        points = depth[:, None] * np.column_stack([rays, np.ones(count)])
        still = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        prior = Prior(motion=still, covariance=1e-4 * np.eye(12), gravity=(0.0, 0.0, 1.0),
                      gravity_deviation=1.0, gravity_in_map=(0.0, 0.0, 1.0))  # fmt: skip
        self.localize(points, pixels, np.arange(count, dtype=np.float64), prior)
        self.localize(points, pixels)

    def localize(
        self,
        points: ArrayLike,
        pixels: ArrayLike,
        scores: ArrayLike | None = None,
        prior: Prior | None = None,
        expected_share: float = 0.5,
    ) -> Estimate | Failure:
        """Estimate pose and velocities from one frame.

        Args:
            points: (n,3) in the map frame, metres.
            pixels: (n,2) raw image coordinates, first pixel centre at 0, 0.
            scores: (n,) quality of the matches, higher is better.
            prior: what else is known of the motion. A prior motion is also a first guess; if the
                points do not agree with it, it is dropped and the whole search runs.
            expected_share: share of inliers among the points that a prior motion should find.

        Returns:
            an :class:`Estimate`, or a :class:`Failure` with its reason. Same seed and same input
            give the same result.

        Raises:
            ValueError: wrong shapes, or values that are not finite.
        """
        points, pixels, scores = checked(points, pixels, scores)
        if not 0.0 <= expected_share <= 1.0:
            raise ValueError(f"expected_share must lie between 0 and 1, got {expected_share}")
        rays = self.camera.rays(pixels)
        seen = np.isfinite(rays[:, 0])
        centre = median_point(points, seen)
        with np.errstate(over="ignore"):
            within = np.abs(points - centre).max(axis=1, initial=0.0) < _FARTHEST_POINT
        usable = np.flatnonzero(seen & within)
        if len(usable) < self.config.min_inliers:
            return Failure(
                Reason.TOO_FEW_POINTS,
                f"{len(usable)} usable points of {len(points)}, "
                f"{self.config.min_inliers} are needed",
            )
        frame = self._frame(points, pixels, rays, usable, centre, scores, prior)
        if prior is not None and prior.motion is not None:
            tracked = self._track(frame, prior, expected_share)
            if tracked:
                return replace(tracked, tracked=True)
        start = self._global_shutter(frame, np.arange(len(usable)), self.config.max_iterations)
        if not start.found:
            return Failure(Reason.NO_HYPOTHESIS, "no three points gave a pose")
        best = self._motion(frame, start)
        start, best = self._largest_group(frame, start, best)
        return self._accept(frame, start, best, self._final(frame, best, frame.terms))

    # -- steps ------------------------------------------------------------------------------

    def _frame(
        self,
        points: Array,
        pixels: Array,
        rays: Array,
        usable: IntArray,
        centre: Array,
        scores: Array | None,
        prior: Prior | None,
    ) -> _Frame:
        deviations = self.config.velocity_prior
        terms = (
            velocity_terms(deviations.angular, deviations.linear)
            if self._solver.rolling_shutter
            else held_terms()
        )
        observations = Observations.of(
            points[usable] - centre,
            rays[usable],
            self.camera.row_time(pixels[usable]),
            self.camera.pixel_jacobian(rays[usable]),
            self.camera.row_time_gradient,
        )
        return _Frame(
            observations,
            usable,
            len(points),
            centre,
            None if scores is None else np.argsort(-scores[usable], kind="stable"),
            terms if prior is None else with_prior(terms, prior.without_motion(), centre),
            generator(self.config.seed),
        )

    def _track(self, frame: _Frame, prior: Prior, expected_share: float) -> Estimate | Failure:
        """The motion nearest to the prior one, if the points agree with it."""
        assert prior.motion is not None
        threshold = self.config.inlier_threshold
        predicted = state_in(prior.motion, frame.centre)
        terms = with_prior(frame.terms, prior.motion_only(), frame.centre)
        best = self._optimize(frame, predicted, _PREDICTION_SCALE * threshold, terms)
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

    def _largest_group(
        self, frame: _Frame, start: Candidate, best: Candidate
    ) -> tuple[Candidate, Candidate]:
        """The start and the motion of another group of points, if it is the larger one.

        The search stays near its global-shutter start. Where that lies on a second moving object,
        the points that it leaves out may hold more inliers than it found.
        """
        if not best.found:
            return start, best
        others = np.flatnonzero(~self._near(frame, start))
        # At the widest gate of the final estimate, so that noise hides none of them.
        gate = WIDEST_GATE * self.config.inlier_threshold
        inliers = frame.observations.squared_errors(best.state) < gate**2
        if not self._solver.rolling_shutter or len(others) <= np.count_nonzero(inliers):
            return start, best
        second = self._global_shutter(frame, others, _SECOND_LOOK_SAMPLES)
        if not second.found or (
            np.count_nonzero(self._near(frame, second)[others]) <= np.count_nonzero(inliers)
        ):
            return start, best
        rival = self._motion(frame, second)
        return (second, rival) if rival.cost < best.cost else (start, best)

    def _near(self, frame: _Frame, start: Candidate) -> BoolArray:
        """Which points may belong to a motion whose global-shutter pose this is."""
        errors = frame.observations.squared_errors(start.state)
        near: BoolArray = errors < (_POOL_SCALE * self._focal_length) ** 2
        return near

    def _global_shutter(self, frame: _Frame, among: IntArray, most: int) -> Candidate:
        """A pose that fits all rows roughly, by P3P on some points and a wide threshold."""
        threshold = self.config.inlier_threshold
        wide = max(_GLOBAL_SHUTTER_SCALE * self._focal_length, threshold)
        if self._solver.rolling_shutter:
            score_scale, final_scale = wide, wide
            most = min(_GLOBAL_SHUTTER_MOST_SAMPLES, most)
        else:
            score_scale, final_scale = _SCORE_SCALE * threshold, threshold
        hypotheses = self._hypotheses(
            find_solver("p3p"), _GLOBAL_SHUTTER_BLOCK, score_scale, final_scale, held_terms()
        )
        return search(
            frame.observations,
            hypotheses,
            [np.eye(3)],
            _pools(frame, among),
            NOTHING,
            self.config.confidence,
            most,
            frame.random,
        )

    def _motion(self, frame: _Frame, start: Candidate) -> Candidate:
        """The motion that most points agree on, from the solver's hypotheses."""
        if not self._solver.rolling_shutter:
            return start
        threshold = self.config.inlier_threshold
        near = np.flatnonzero(self._near(frame, start))
        # The global-shutter pose is a hypothesis, too: at rest it is the best one.
        first = self._optimize(frame, start.state, _POOL_SCALE * self._focal_length, frame.terms)
        hypotheses = self._hypotheses(
            self._solver, _BLOCK, _SCORE_SCALE * threshold, threshold, frame.terms
        )
        return search(
            frame.observations,
            hypotheses,
            [start.state[:9].reshape(3, 3)],
            [Pool(near), *_pools(frame, np.arange(len(frame.observations)))],
            first,
            self.config.confidence,
            self.config.max_iterations,
            frame.random,
        )

    def _final(self, frame: _Frame, best: Candidate, terms: PriorTerms) -> Posterior:
        """The maximum a posteriori motion of the inliers, nearer to rest if they show none."""
        threshold = self.config.inlier_threshold
        posterior = maximum_a_posteriori(frame.observations, best.state, terms, threshold)
        # Unless more is known of this very frame than the velocity prior of the configuration.
        uninformed = len(terms.informations) == 1 and self._solver.rolling_shutter
        if uninformed and determines_motion(posterior):
            return weigh_against_rest(frame.observations, posterior)
        return posterior

    def _accept(
        self, frame: _Frame, start: Candidate, best: Candidate, posterior: Posterior
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
        self, frame: _Frame, start: Candidate, best: Candidate, posterior: Posterior
    ) -> Estimate:
        state = posterior.state
        rotation = state[:9].reshape(3, 3)
        residuals = np.full(frame.count, np.nan)
        residuals[frame.usable] = np.sqrt(posterior.squared_errors)
        inliers = np.zeros(frame.count, dtype=np.bool_)
        inliers[frame.usable] = posterior.inliers
        return Estimate(
            rotation=rotation,
            translation=state[9:12] - rotation @ frame.centre,
            angular_velocity=state[12:15],
            linear_velocity=state[15:18],
            inliers=inliers,
            residuals=residuals,
            covariance=posterior.covariance,
            global_shutter_inliers=self._global_shutter_inliers(frame, start),
            iterations=best.samples,
        )

    # -- helpers ----------------------------------------------------------------------------

    @property
    def _focal_length(self) -> float:
        """In delivered pixels."""
        K, binning = self.camera.K, self.camera.binning
        return float(math.sqrt(K[0, 0] / binning[0] * K[1, 1] / binning[1]))

    @property
    def _expected_noise(self) -> float:
        """px, before it has been measured."""
        return 0.5 * self.config.inlier_threshold

    def _hypotheses(
        self,
        solver: Solver,
        block: int,
        score_scale: float,
        final_scale: float,
        terms: PriorTerms,
    ) -> Hypotheses:
        iterations = self.config.solver_iterations

        def solve(
            points: Array,
            rays: Array,
            tau: Array,
            samples: IntArray,
            rotations: Array,
            models: Array,
        ) -> None:
            solver.solve(points, rays, tau, samples, rotations, iterations, models)

        return Hypotheses(
            solve=solve,
            sample_size=solver.sample_size,
            solutions=solver.solutions,
            block=block,
            score_scale=score_scale,
            final_scale=final_scale,
            prior=terms,
            noise=self._expected_noise,
        )

    def _optimize(
        self, frame: _Frame, state: Array, first_scale: float, terms: PriorTerms
    ) -> Candidate:
        """Local optimisation of one state down to the inlier threshold."""
        optimized, cost = optimize(
            state[None],
            np.zeros(1),
            frame.observations.packed,
            frame.observations.row_time_gradient,
            first_scale,
            self.config.inlier_threshold,
            terms,
            self._expected_noise,
        )
        return Candidate(optimized, cost)

    def _global_shutter_inliers(self, frame: _Frame, start: Candidate) -> int:
        """How many points a global-shutter pose explains at the inlier threshold."""
        threshold = self.config.inlier_threshold
        still = np.concatenate([start.state[:12], np.zeros(6)])
        pose = self._optimize(frame, still, 2.0 * _SCORE_SCALE * threshold, held_terms())
        return int(np.count_nonzero(frame.observations.squared_errors(pose.state) < threshold**2))


def _pools(frame: _Frame, among: IntArray) -> list[Pool]:
    everything = Pool(among)
    # Half of the samples ignore the scores, so that wrong ones cost a factor of two at most.
    if frame.ranking is None:
        return [everything]
    return [Pool(frame.ranking[np.isin(frame.ranking, among)], ranked=True), everything]
