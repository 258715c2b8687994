"""The method: from 2D-3D correspondences of one frame to a pose and its velocities."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.ransac import Candidate, Hypotheses, Observations, search
from rs_localizer.core.refine import Posterior, invert_information, refine
from rs_localizer.core.residuals import set_weights
from rs_localizer.core.sampling import IntArray, Pool, Random, generator
from rs_localizer.core.scoring import optimize
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import Estimate, Failure, Reason
from rs_localizer.solvers import Solver, find_solver

# A global-shutter pose under motion misses the points of the first and last rows by a good part
# of the image; it only has to be right to some degrees. In focal lengths.
_GLOBAL_SHUTTER_SCALE = 0.05
_POOL_SCALE = 0.12
# Minimal models are scored at this multiple of the inlier threshold: noise makes a six-point
# model miss the other inliers by several times their own noise.
_SCORE_SCALE = 4.0
_GLOBAL_SHUTTER_BLOCK = 48
_BLOCK = 64
_GLOBAL_SHUTTER_MOST_SAMPLES = 384
# Velocities of a global-shutter motion are held at zero by a prior.
_HELD = np.full(6, 1e18)
# Inliers of the final estimate lie within this many standard deviations of the measured noise
# (99.8 % of Rayleigh-distributed errors), but the threshold is widened at most twofold.
_GATE = 3.5
_WIDEST = 2.0
_FINAL_ROUNDS = 3
_FINAL_ITERATIONS = 10
# Positions of image points are never better than this, in pixels; it also keeps noise-free data
# from claiming an infinite information.
_LEAST_NOISE = 1e-4
# Of the information matrix scaled to a unit diagonal.
_LEAST_EIGENVALUE = 1e-11
# Beyond this the camera turns by more than the motion model is meant for.
_MOST_TURN = 1.5


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
        width, height = self.camera.size
        grid = np.linspace(0.3, 0.7, 5)
        u, v = (g.ravel() for g in np.meshgrid(grid * width, grid * height))
        pixels = np.column_stack([u, v])
        depth = 2.0 + np.arange(len(pixels)) % 3  # not a plane
        rays = np.nan_to_num(self.camera.rays(pixels))
        self.localize(depth[:, None] * np.column_stack([rays, np.ones(len(rays))]), pixels)

    def localize(
        self, points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None = None
    ) -> Estimate | Failure:
        """Estimate pose and velocities from one frame.

        Args:
            points: (n,3) in the map frame, metres.
            pixels: (n,2) raw image coordinates, first pixel centre at 0, 0.
            scores: (n,) quality of the matches, higher is better.

        Returns:
            an :class:`Estimate`, or a :class:`Failure` with its reason. Same seed and same input
            give the same result.

        Raises:
            ValueError: wrong shapes, or values that are not finite.
        """
        points, pixels, scores = _checked(points, pixels, scores)
        rays = self.camera.rays(pixels)
        usable = np.flatnonzero(np.isfinite(rays).all(axis=1))
        if len(usable) < self.config.min_inliers:
            return Failure(
                Reason.TOO_FEW_POINTS,
                f"{len(usable)} usable points of {len(points)}, "
                f"{self.config.min_inliers} are needed",
            )
        centre = points[usable].mean(axis=0)
        observations = Observations.of(
            points[usable] - centre,
            rays[usable],
            self.camera.row_time(pixels[usable]),
            self.camera.pixel_jacobian(rays[usable]),
            self.camera.row_time_gradient,
        )
        ranking = None if scores is None else np.argsort(-scores[usable], kind="stable")
        random = generator(self.config.seed)

        start = self._global_shutter(observations, ranking, random)
        if not start.found:
            return Failure(Reason.NO_HYPOTHESIS, "no three points gave a pose")
        best = self._motion(observations, ranking, start, random)
        posterior = self._final(observations, best)
        return self._result(observations, usable, len(points), centre, start, best, posterior)

    # -- steps ------------------------------------------------------------------------------

    def _global_shutter(
        self, observations: Observations, ranking: IntArray | None, random: Random
    ) -> Candidate:
        """A pose that fits all rows roughly, by P3P and a wide threshold."""
        rolling = self._solver.rolling_shutter
        threshold = self.config.inlier_threshold
        wide = max(_GLOBAL_SHUTTER_SCALE * self._focal_length, threshold)
        hypotheses = self._hypotheses(
            find_solver("p3p"),
            block=_GLOBAL_SHUTTER_BLOCK,
            score_scale=wide if rolling else _SCORE_SCALE * threshold,
            final_scale=wide if rolling else threshold,
            prior=_HELD,
        )
        return search(
            observations, hypotheses, [np.eye(3)], _pools(observations, ranking), _NOTHING,
            self.config.confidence,
            min(_GLOBAL_SHUTTER_MOST_SAMPLES, self.config.max_iterations)
            if rolling
            else self.config.max_iterations,
            random,
        )  # fmt: skip

    def _motion(
        self, observations: Observations, ranking: IntArray | None, start: Candidate, random: Random
    ) -> Candidate:
        """The motion that most points agree on, from the solver's hypotheses."""
        if not self._solver.rolling_shutter:
            return start
        threshold = self.config.inlier_threshold
        errors = observations.squared_errors(start.state)
        near = np.flatnonzero(errors < (_POOL_SCALE * self._focal_length) ** 2)
        hypotheses = self._hypotheses(
            self._solver,
            block=_BLOCK,
            score_scale=_SCORE_SCALE * threshold,
            final_scale=threshold,
            prior=self._prior,
        )
        # The global-shutter pose is a hypothesis, too: at rest it is the best one.
        state, cost = optimize(
            start.state[None], np.zeros(1), observations.packed, observations.row_time_gradient,
            _POOL_SCALE * self._focal_length, threshold, self._prior, hypotheses.noise,
        )  # fmt: skip
        pools = [Pool(near), *_pools(observations, ranking)]
        return search(
            observations, hypotheses, [start.state[:9].reshape(3, 3)], pools,
            Candidate(state, cost), self.config.confidence, self.config.max_iterations, random,
        )  # fmt: skip

    def _final(self, observations: Observations, best: Candidate) -> Posterior:
        """The maximum a posteriori motion of the inliers, which its noise decides."""
        threshold = self.config.inlier_threshold
        prior = self._prior if self._solver.rolling_shutter else _HELD
        state, gate, freedom = best.state, threshold, 0.0
        errors = observations.squared_errors(state)
        for _ in range(_FINAL_ROUNDS):
            noise = noise_deviation(errors, gate, freedom)
            gate = min(max(threshold, _GATE * noise), _WIDEST * threshold)
            set_weights(observations.packed, (errors < gate * gate).astype(np.float64))
            state, information, _, _ = refine(
                observations.packed, state, observations.row_time_gradient, 1e6, 0.0, prior,
                noise, _FINAL_ITERATIONS,
            )  # fmt: skip
            errors = observations.squared_errors(state)
            inverse, smallest = invert_information(information)
            # The prior takes a part of the twelve degrees of freedom.
            freedom = 12.0 - noise**2 * float(prior @ np.diag(inverse)[6:])
        noise = noise_deviation(errors, gate, freedom)
        return Posterior(state, noise**2 * inverse, smallest, errors < gate * gate, errors)

    def _result(
        self,
        observations: Observations,
        usable: IntArray,
        count: int,
        centre: Array,
        start: Candidate,
        best: Candidate,
        posterior: Posterior,
    ) -> Estimate | Failure:
        """Accept the motion or say what is wrong with it."""
        found = int(np.count_nonzero(posterior.inliers))
        if found < self.config.min_inliers:
            return Failure(
                Reason.TOO_FEW_INLIERS,
                f"{found} inliers of {len(usable)} points after {best.samples} samples, "
                f"{self.config.min_inliers} are needed",
            )
        if not posterior.smallest_eigenvalue > _LEAST_EIGENVALUE:
            return Failure(
                Reason.DEGENERATE,
                f"{found} inliers do not determine the motion: smallest eigenvalue of the scaled "
                f"information {posterior.smallest_eigenvalue:.1e}",
            )
        state = posterior.state
        turn = float(np.linalg.norm(state[12:15]))
        if turn > _MOST_TURN:
            return Failure(
                Reason.IMPLAUSIBLE,
                f"the camera would turn by {math.degrees(turn):.0f} deg per readout",
            )
        rotation = state[:9].reshape(3, 3)
        residuals = np.full(count, np.nan)
        residuals[usable] = np.sqrt(posterior.squared_errors)
        inliers = np.zeros(count, dtype=np.bool_)
        inliers[usable] = posterior.inliers
        return Estimate(
            rotation=rotation,
            translation=state[9:12] - rotation @ centre,
            angular_velocity=state[12:15],
            linear_velocity=state[15:18],
            inliers=inliers,
            residuals=residuals,
            covariance=posterior.covariance,
            global_shutter_inliers=self._global_shutter_inliers(observations, start),
            iterations=best.samples,
        )

    # -- helpers ----------------------------------------------------------------------------

    @property
    def _focal_length(self) -> float:
        """In delivered pixels."""
        K, binning = self.camera.K, self.camera.binning
        return float(math.sqrt(K[0, 0] / binning[0] * K[1, 1] / binning[1]))

    @property
    def _prior(self) -> Array:
        deviations = self.config.velocity_prior
        return np.repeat(
            [0.0 if d == 0.0 else d**-2 for d in (deviations.angular, deviations.linear)], 3
        )

    def _hypotheses(
        self, solver: Solver, block: int, score_scale: float, final_scale: float, prior: Array
    ) -> Hypotheses:
        def solve(
            points: Array,
            rays: Array,
            tau: Array,
            samples: IntArray,
            rotations: Array,
            models: Array,
        ) -> None:
            solver.solve(
                points, rays, tau, samples, rotations, self.config.solver_iterations, models
            )

        return Hypotheses(
            solve=solve,
            sample_size=solver.sample_size,
            solutions=solver.solutions,
            block=block,
            score_scale=score_scale,
            final_scale=final_scale,
            prior=prior,
            noise=0.5 * self.config.inlier_threshold,
        )

    def _global_shutter_inliers(self, observations: Observations, start: Candidate) -> int:
        """How many points a global-shutter pose explains at the inlier threshold."""
        threshold = self.config.inlier_threshold
        set_weights(observations.packed, np.ones(len(observations)))
        state, _ = optimize(
            start.state[None], np.zeros(1), observations.packed, observations.row_time_gradient,
            2.0 * _SCORE_SCALE * threshold, threshold, _HELD, 0.5 * threshold,
        )  # fmt: skip
        return int(np.count_nonzero(observations.squared_errors(state) < threshold**2))


_NOTHING = Candidate(np.zeros(18), math.inf)


def _pools(observations: Observations, ranking: IntArray | None) -> list[Pool]:
    everything = Pool(np.arange(len(observations)))
    # Half of the samples ignore the scores, so that wrong ones cost a factor of two at most.
    return [everything] if ranking is None else [Pool(ranking, ranked=True), everything]


def noise_deviation(squared_errors: Array, gate: float, freedom: float) -> float:
    """Standard deviation of the pixel noise from the errors within a gate.

    Args:
        squared_errors: (n,) of all points.
        gate: px.
        freedom: degrees of freedom that the fit has used up.

    The errors of true inliers are Rayleigh distributed; cutting them off at the gate lowers their
    mean square by a factor that depends on the deviation itself, hence the fixed point.
    """
    within = squared_errors[squared_errors < gate * gate]
    left = 2 * len(within) - freedom
    if left <= 0.0:
        return gate / _GATE
    mean = float(within.sum()) / left
    variance = mean
    for _ in range(20):
        u = gate * gate / (2.0 * max(variance, 1e-12 * gate * gate))
        kept = 1.0 - u * math.exp(-u) / -math.expm1(-u)
        variance = min(mean / max(kept, 1e-3), gate * gate)
    return max(math.sqrt(variance), _LEAST_NOISE)


def _checked(
    points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None
) -> tuple[Array, Array, Array | None]:
    points = np.ascontiguousarray(points, dtype=np.float64)
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    n = len(points)
    if points.shape != (n, 3) or pixels.shape != (n, 2):
        raise ValueError(
            f"points must be (n,3) and pixels (n,2), got {points.shape} and {pixels.shape}"
        )
    checks = [("points", points), ("pixels", pixels)]
    if scores is not None:
        scores = np.ascontiguousarray(scores, dtype=np.float64)
        if scores.shape != (n,):
            raise ValueError(f"scores must be ({n},), got {scores.shape}")
        checks.append(("scores", scores))
    for name, array in checks:
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} must be finite, found NaN or infinity")
    return points, pixels, scores
