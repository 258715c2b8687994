# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The method: from 2D-3D correspondences of one frame to a pose and its velocities."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import LocalizerConfig, RefinementKind, localizer_config
from rs_localizer.core.arrays import Array, instance, real
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.core.rig import Rig, RigEstimate
from rs_localizer.core.rotation_prior import RotationPrior
from rs_localizer.core.state import (
    MOTION_PARAMETERS,
    PARAMETERS,
    POSE,
    VELOCITIES,
    step_between,
)
from rs_localizer.core.types import Estimate, Failure, altered
from rs_localizer.estimation.acceptance import (
    estimate_of,
    noise_fills,
    refusal,
    speeding,
    too_few,
    uncertain,
    unfit,
)
from rs_localizer.estimation.calibration import (
    NO_EFFECT,
    LandmarkErrors,
    calibration_effect,
    widened,
)
from rs_localizer.estimation.hypotheses import Posterior, frame_posterior
from rs_localizer.estimation.known_rotation import coupled_turn
from rs_localizer.estimation.left_out import BENT, SAMPLE, LeftOut, by_chance, left_out, reordered
from rs_localizer.estimation.moved_part import MovedParts
from rs_localizer.estimation.points import (
    NEAREST,
    FrameSights,
    Observed,
    checked,
    checked_of_rig,
    find_usable,
    packed,
)
from rs_localizer.estimation.prior import (
    Assumed,
    Prior,
    PriorTerms,
    assumptions,
    knows_motion,
    knows_speed,
    of_frame,
    state_in,
    with_motion,
)
from rs_localizer.estimation.robust import GATE, WIDEST_GATE, best_motion
from rs_localizer.estimation.search import Candidate, MotionSearch, generator
from rs_localizer.solvers.table import find_solver, start_solver

# A prediction may be wrong by this multiple of the inlier threshold.
_PREDICTION_SCALE = 16.0
# With one standard deviation in each direction, 95 % of the points lie within this many of them
# (Rayleigh's distribution).
_MAP_GATE = 2.45
# rad/s, twice the range of most sensors (2000 deg/s).
_FASTEST_RATE = 70.0
_UNRANKED = np.zeros(0, np.int64)
# Least share of inliers near a prediction, over the share that agreed before.
_STILL_TRACKED = 0.7
# If noise fills a gate, it is widened up to this many times, by at least this factor at a time.
_WIDEST, _LEAST_WIDER = 4.0, 1.25
# Errors of a rough map, in focal lengths, beyond which poses are known to some ten degrees only.
_ROUGHEST = 0.04
# Noise is half-normal, of this part of the gate: users leave room for errors of 3.5 deviations.
_NOISE = 0.25


def _is_bent(found: Estimate) -> bool:
    """Return whether smooth errors are larger than boards of paper have them."""
    return found.model_error > BENT * found.declared_error


def _leaves_out(found: Estimate, tracked: Estimate) -> bool:
    """Return whether a motion leaves out the points that bend a track, which creep away.

    A motion that fits all points does not: before a wrong lens the track is the better one.
    """
    return bool(np.count_nonzero(tracked.inliers & ~found.inliers) > SAMPLE)


def _with_other(found: Estimate, tracked: Estimate) -> Estimate:
    """Return a motion whose region also holds the motion that the track has found.

    Nobody knows how fast the track is: either the camera has gone farther, or a wrong lens shows
    it so.
    """
    origin = np.zeros(3)
    step = step_between(state_in(found, origin), state_in(tracked, origin))[:MOTION_PARAMETERS]
    moment = found.moved_covariance + np.outer(step, step)
    return altered(found, moved_covariance=moment)


def _contradiction(found: Estimate, prior: Prior) -> str:
    """Return by how much measurements differ from what points show that fit without them."""
    off = []
    if prior.gravity is not None:
        down = np.asarray(prior.gravity, float)
        seen = found.rotation @ np.asarray(prior.gravity_in_map, float)
        angle = math.atan2(float(np.linalg.norm(np.cross(down, seen))), float(down @ seen))
        off.append((angle, "gravity", "rad", prior.gravity_deviation))
    if prior.angular_velocity is not None:
        rate = math.dist(found.angular_velocity, np.asarray(prior.angular_velocity, float))
        off.append((rate, "angular_velocity", "rad a readout", prior.angular_velocity_deviation))
    said = (f"{x:.2g} {unit} off {name}, given to {given:.2g}" for x, name, unit, given in off)
    return (
        f"{np.count_nonzero(found.inliers)} points fit without the prior's measurements, and not "
        f"with them: their motion is {' and '.join(said)}. Are these in camera axes, of this sign "
        "and unit?"
    )


class Localizer:
    """Rolling-shutter absolute pose of single frames.

    Args:
        camera: calibrated camera with its shutter, or a :class:`rs_localizer.Rig` of several.
        config: all settings, or give single ones as keywords (see :class:`LocalizerConfig`).

    Raises:
        ValueError: a setting is unknown, out of range, or names a solver that is not available.
    """

    def __init__(
        self, camera: Camera | Rig, config: LocalizerConfig | None = None, **settings: object
    ) -> None:
        self._alone = not isinstance(camera, Rig)
        if not isinstance(camera, Rig):
            instance("camera", camera, Camera)
            camera = Rig.of(camera)
        if config is not None:
            instance("config", config, LocalizerConfig)
        if config is not None and settings:
            raise ValueError(f"give either config or settings, got both: {', '.join(settings)}")
        self.config = config or localizer_config(settings)
        self.rig = camera
        self._solver = find_solver(self.config.solver)
        self._search = MotionSearch(
            camera.focal_length, self.config, self._solver, start_solver(self._solver)
        )
        self._full = self.config.refinement == RefinementKind.FULL
        self._exposure = camera.exposure()
        # A rig of cameras with a common trigger has few different spans.
        self._assume = lru_cache(16)(
            partial(assumptions, rig=camera, config=self.config, solver=self._solver)
        )

    def __reduce__(self) -> tuple[Any, ...]:  # made anew in the process that unpickles it
        return type(self), (self.camera if self._alone else self.rig, self.config)

    def __repr__(self) -> str:
        ordinary, values = LocalizerConfig(), self.config
        own = [
            f", {field.name}={getattr(values, field.name)!r}"
            for field in fields(ordinary)
            if getattr(values, field.name) != getattr(ordinary, field.name)
        ]
        seen = ", ".join(
            f"{name} {each.width}x{each.height}, {1e3 * each.readout_time:g} ms "
            f"{each.scan_direction}".strip()
            for name, each in self.rig.cameras.items()
        )
        return f"Localizer({seen}, solver={values.solver!r}{''.join(own)})"

    @property
    def camera(self) -> Camera:
        """The only camera; ``ValueError`` if there are several."""
        if len(self.rig.cameras) > 1:
            raise ValueError(f"the rig has several cameras: {', '.join(self.rig.cameras)}")
        return next(iter(self.rig.cameras.values()))

    def localize(
        self,
        points: ArrayLike | Mapping[str, Sequence[ArrayLike]],
        pixels: ArrayLike | None = None,
        scores: ArrayLike | None = None,
        *,
        prior: Prior | None = None,
        expected_share: float = 0.5,
        rotation: RotationPrior | None = None,
        stamps: Mapping[str, float] | None = None,
    ) -> Estimate | Failure:
        """Estimate pose and velocities from one image, or from the images of a rig.

        Args:
            points: (n,3) in the map frame, metres. For a rig ``{name: (points, pixels)}``, or
                ``(points, pixels, scores)``, of the cameras that take part in the frame.
            pixels: (n,2) raw image coordinates, first pixel centre at 0, 0.
            scores: (n,) quality of the matches, higher is better.
            prior: other knowledge of the motion. A prior motion is also a first guess; if the
                points do not agree with it, it is dropped and the whole search runs.
            expected_share: share of inliers among the points that a prior motion should find.
            rotation: knowledge of the rotation of the camera during the readout. A prior motion is
                then the motion beside that rotation.
            stamps: for a rig, times (s) at which the first row of each image was exposed, relative
                to anything; None: all at once.

        Returns: an :class:`Estimate` (a :class:`RigEstimate` for a rig), or a :class:`Failure` with
            its reason. Same seed and same input give the same result.

        Raises:
            ValueError: wrong shapes, values that are not finite, or a prior or rotation where
                ``refinement`` uses none.
        """
        if not self._full and (prior is not None or rotation is not None):
            raise ValueError(
                f"refinement {self.config.refinement} knows the points alone: neither a prior nor "
                "a rotation"
            )
        sights = self.sights(points, pixels, scores, stamps)
        found = self.accepted(self.find(sights, prior, expected_share, rotation))
        measured = prior is not None and not (prior.gravity is prior.angular_velocity is None)
        if prior is not None and measured and (not found or _is_bent(found)):
            alone = self.accepted(self.find(sights, rotation=rotation))
            if alone and not _is_bent(alone):
                return Failure(Reason.PRIOR, _contradiction(alone, prior))
        return found

    def accepted(self, found: Estimate | Failure) -> Estimate | Failure:
        """Return the estimate, or a :class:`Failure` if its orientation is too uncertain."""
        if not found or self.config.refinement == RefinementKind.NONE:
            return found
        failure = uncertain(found)
        return found if failure is None else failure

    def find(
        self,
        sights: FrameSights,
        prior: Prior | None = None,
        expected_share: float = 0.5,
        rotation: RotationPrior | None = None,
        error_modes: LandmarkErrors | None = None,
        parts: MovedParts | None = None,
    ) -> Estimate | Failure:
        """Localize as :meth:`localize`, however uncertain: the next frames may know better.

        ``sights`` are of :meth:`sights`, ``error_modes`` those of the map of these points, if it
        has them, and ``parts`` watches whether parts of it have moved; they enter covariances.
        Arguments that ``refinement`` does not use are ignored.
        """
        if not self._full:
            prior = rotation = None
        if prior is not None:
            instance("prior", prior, Prior)
            self._check_rate(prior)
        real("expected_share", expected_share, "between 0 and 1", 0.0, 1.0)
        # 1. What can be used: finite, distinct, inside the image; packed relative to its median.
        exposure, counts, points, pixels, scores, usable, observations = sights
        if rotation is not None:
            instance("rotation", rotation, RotationPrior)
            if not exposure.alone:
                raise ValueError("a known rotation is that of a camera alone, not of a rig")
            exposure = exposure.ahead()
            usable = find_usable(exposure, points, pixels, counts, rotation)
            observations = packed(exposure, points, usable)
        failure = unfit(exposure, pixels, usable, self.config.min_inliers)
        if failure is not None:
            return failure
        ranking = _UNRANKED
        if scores is not None:
            ranking = np.argsort(-scores[usable.indices], kind="stable")
        terms, assumed = of_frame(*self._assume(exposure.span), prior, rotation)
        found = self._found(Observed(
            observations, ranking, terms, generator(self.config.seed), assumed, exposure, points,
            usable, rotation, error_modes, parts,
        ), prior, expected_share)  # fmt: skip
        return found if self._alone or not found else RigEstimate.of(found, exposure, counts)

    def _check_rate(self, prior: Prior) -> None:
        """Refuse a rate that no sensor measures."""
        if prior.angular_velocity is None or not self._exposure.span > 0.0:
            return
        rate = float(np.linalg.norm(np.asarray(prior.angular_velocity, float)))
        if rate / self._exposure.span > _FASTEST_RATE:
            raise ValueError(
                f"angular_velocity of the prior, {rate:.3g} rad per readout, would be "
                f"{rate / self._exposure.span:.3g} rad/s, more than sensors measure: is it in "
                "rad/s, or in degrees? Multiply rad/s by the readout time"
            )

    def sights(
        self, points: Any, pixels: Any = None, scores: Any = None,
        stamps: Mapping[str, float] | None = None,
    ) -> FrameSights:  # fmt: skip
        """Check and pack the points of a frame; arguments and errors are of :meth:`localize`."""
        if self._alone:
            if isinstance(points, Mapping) or stamps is not None:
                raise ValueError("images by names, and their stamps, are those of a Rig")
            points, pixels, scores = checked(points, pixels, scores)
            # One camera costs less than six.
            exposure, counts = self._exposure.ahead(pixels), [len(points)]
        elif not isinstance(points, Mapping) or pixels is not None or scores is not None:
            raise ValueError(
                "a frame of a rig is {name: (points, pixels)}, also with scores behind them; its "
                f"cameras are {', '.join(self.rig.cameras)}"
            )
        else:
            exposure, counts, points, pixels, scores = checked_of_rig(self.rig, points, stamps)
        usable = find_usable(exposure, points, pixels, counts, None)
        seen = packed(exposure, points, usable)
        return FrameSights(exposure, counts, points, pixels, scores, usable, seen)

    def _found(
        self, observed: Observed, prior: Prior | None, expected_share: float
    ) -> Estimate | Failure:
        # 2. Near the predicted motion, if the points agree with it (tracking).
        tracked = None
        if prior is not None and prior.motion is not None:
            tracked = self._track(observed, prior, expected_share)
            if tracked and not _is_bent(tracked):
                return altered(tracked, tracked=True)
        found = self._searched(observed)
        if not tracked or prior is None:
            return found
        if found:
            is_bent = _is_bent(found)
            if not is_bent and _leaves_out(found, tracked):
                return found
            if uncertain(tracked) is None:
                is_other = not (is_bent or knows_speed(observed.terms, prior))
            else:
                is_other = uncertain(found) is None
            if is_other:
                return _with_other(found, tracked)
        return altered(tracked, tracked=True)

    def _searched(self, observed: Observed) -> Estimate | Failure:
        # 3. A global-shutter start, then hypotheses of the solver (LO-RANSAC).
        best = self._search.find(observed)
        if not best.found:
            return Failure(
                Reason.NO_HYPOTHESIS,
                "no three points of one camera gave a pose: do they lie on a line or in a point?",
            )
        if self.config.refinement == RefinementKind.NONE:
            return self._minimal(observed, best)
        # 4. Maximum a posteriori on the inliers; rest or motion; the leans of a plane.
        posterior = self._settle(observed, best, observed.terms)
        # 5. Nothing rather than a wrong pose.
        return self._accept(observed, best, posterior)

    def _minimal(self, observed: Observed, best: Candidate) -> Estimate | Failure:
        """Return the model of a minimal sample as it is, without a covariance."""
        errors, needed = observed.observations.squared_errors(best.state), self.config.min_inliers
        inliers = errors < self.config.inlier_threshold**2
        if np.count_nonzero(inliers) < needed:
            return too_few(inliers, errors, best.samples, needed)
        unknown = np.full((PARAMETERS, PARAMETERS), math.nan)
        posterior = Posterior(best.state, unknown, math.nan, 0.0, math.nan, inliers, errors)
        return estimate_of(observed, posterior, best.samples, NO_EFFECT, predicted=True)

    def _track(self, observed: Observed, prior: Prior, expected_share: float) -> Estimate | Failure:
        """Find the motion nearest to the prior one, if the points agree with it."""
        assert prior.motion is not None
        threshold = self.config.inlier_threshold
        predicted = state_in(prior.motion, observed.centre)
        terms = with_motion(observed.terms, prior, observed.centre, observed.rotation is not None)
        best = self._search.optimize(observed, predicted, _PREDICTION_SCALE * threshold, terms)
        posterior = self._settle(observed, best, terms)
        result = self._accept(observed, best, posterior, prior)
        if result and np.count_nonzero(result.inliers) < (
            _STILL_TRACKED * expected_share * len(observed.observations)
        ):
            return Failure(
                Reason.TOO_FEW_INLIERS,
                f"{np.count_nonzero(result.inliers)} inliers near the prior motion, "
                f"{expected_share:.0%} of {len(observed.observations)} were expected",
            )
        return result

    def known_of(
        self, prior: Prior | None, span: float, rotation: RotationPrior | None = None
    ) -> PriorTerms:
        """Return the prior of a frame in the map's frame, from all knowledge beside its points.

        Args:
            prior: of which the motion counts; None: the settings alone.
            span: s, of the row times.
            rotation: beside which the motion is.
        """
        terms, assumed = self._assume(span)
        terms, _ = of_frame(terms, assumed, None, rotation)
        return (
            terms if prior is None else with_motion(terms, prior, np.zeros(3), rotation is not None)
        )

    def _settle(self, observed: Observed, best: Candidate, terms: PriorTerms) -> Posterior:
        # Unless more is known of this very frame than the prior of the configuration.
        may_rest = self._assume(self._exposure.span)[1].may_rest and len(terms.informations) == 1
        gate, in_frame = self._gate(observed, best.state), None
        if observed.rotation is not None:
            in_frame = coupled_turn(observed.rotation, terms is not observed.terms)
        assumed = observed.assumed._replace(
            may_rest=may_rest, lenses=observed.exposure.lenses, in_frame=in_frame,
            noise=_NOISE * gate,
        )  # fmt: skip
        observations = observed.observations
        if not self._full:
            seen = observations.packed, len(observations)
            return Posterior(*best_motion(*seen, best.state, terms, gate))._replace(gate=gate)
        threshold, most, rolling = gate, _WIDEST * gate, self._solver.rolling_shutter
        searched = terms is observed.terms and rolling
        while True:
            posterior = frame_posterior(observations, best.state, terms, gate, assumed)
            posterior = posterior._replace(gate=gate)
            # As long as the noise fills the gate, nobody knows how much it is.
            if gate < most and noise_fills(posterior, gate, rolling):
                gate = min(max(GATE / WIDEST_GATE * posterior.noise, _LEAST_WIDER * gate), most)
            elif (
                gate < most
                and searched
                and (
                    np.count_nonzero(posterior.inliers) < self.config.min_inliers
                    or by_chance(observed, posterior, gate) is not None
                )
            ):
                gate = most  # some of few points that vibrate fit a motion without vibration
            elif rolling and noise_fills(posterior, threshold, rolling):
                return self._of_rough_map(observed, posterior, terms, assumed)
            else:
                return posterior

    def _of_rough_map(
        self, observed: Observed, posterior: Posterior, terms: PriorTerms, assumed: Assumed
    ) -> Posterior:
        """Return the posterior before a map that is off by more than anybody said.

        The frame tells how far its points are off, and is then fitted with that ``map_deviation``.
        """
        noise, vibrating = 0.0, posterior
        most = max(_ROUGHEST * assumed.focal_length, posterior.noise)
        while posterior.noise > _LEAST_WIDER * noise and noise < most:
            noise = min(posterior.noise, most)
            gate = _MAP_GATE * noise
            # Near a motion of few of them that happen to fit, others are found from far.
            state = self._search.optimize(
                observed, posterior.state, 2.0 * _MAP_GATE * most, terms, gate
            ).state
            deviation = noise * self._depth(observed, state) / assumed.focal_length
            assumed = assumed._replace(map_deviation=deviation, noise=_NOISE * gate)
            posterior = frame_posterior(observed.observations, state, terms, gate, assumed)
        if not len(vibrating.shake):
            return posterior._replace(gate=gate)
        # Few points that vibrate look alike: regions of the velocities hold both.
        undetected = posterior.undetected.copy()
        step = step_between(posterior.state, vibrating.state)[VELOCITIES]
        undetected[VELOCITIES, VELOCITIES] += (
            np.outer(step, step) + vibrating.covariance[VELOCITIES, VELOCITIES]
        )
        return posterior._replace(gate=gate, undetected=undetected)

    def _gate(self, observed: Observed, state: Array) -> float:
        """Return the inlier threshold (px), widened by the declared deviation of the map."""
        threshold, deviation = self.config.inlier_threshold, self.config.map_deviation
        if not deviation > 0.0:
            return threshold
        depth = self._depth(observed, state)
        return math.hypot(threshold, _MAP_GATE * deviation * observed.assumed.focal_length / depth)

    def _depth(self, observed: Observed, state: Array) -> float:
        """Return the median depth (m) of all points."""
        observations = observed.observations
        every = np.ones(len(observations), dtype=np.bool_)
        return max(observations.median_depth(state, every), NEAREST)

    def _own_terms(self, observed: Observed, prior: Prior) -> PriorTerms:
        """Return the prior of a frame from itself and from the velocities of earlier frames.

        Poses of earlier frames, and so the predicted one, have the calibration error of this frame.
        """
        covariance = np.array(prior.covariance, float)
        covariance[POSE] = covariance[:, POSE] = 0.0
        np.fill_diagonal(covariance[POSE, POSE], np.inf)
        of_velocities = altered(prior, covariance=covariance)
        turned = observed.rotation is not None
        return with_motion(observed.terms, of_velocities, observed.centre, turned)

    def _accept(
        self, observed: Observed, best: Candidate, posterior: Posterior, prior: Prior | None = None
    ) -> Estimate | Failure:
        """Accept the motion or say what is wrong with it.

        Args:
            prior: which predicted the motion.
        """
        # A first guess that knows nothing is no prediction.
        tracked, terms = prior is not None and knows_motion(prior), observed.terms
        if prior is not None and tracked:
            terms = self._own_terms(observed, prior)
        effect, rolling = NO_EFFECT, self._solver.rolling_shutter
        parts = observed.parts if rolling and observed.exposure.alone else None
        part = None if parts is None else parts.part
        effect_of = partial(
            calibration_effect, observed, posterior, terms, self.config.calibration, tracked
        )
        enough = np.count_nonzero(posterior.inliers) >= self.config.min_inliers
        if enough and posterior.determined and np.all(np.isfinite(posterior.state)):
            effect = effect_of(part)
        posterior = posterior._replace(
            declared=math.hypot(posterior.declared, effect.residual),  # px, of map and calibration
            speeding=speeding(observed, posterior.state),
        )
        gate = self._gate(observed, posterior.state)
        failure = refusal(
            posterior, best.samples, min_inliers=self.config.min_inliers, threshold=gate,
            rolling=rolling,
        )  # fmt: skip
        if failure is not None:
            searched = rolling and not tracked
            in_order = reordered(self._search, observed, gate) if searched else None
            return failure if in_order is None else in_order
        odd = LeftOut()
        if rolling:  # a global shutter leaves out rows of one that moves
            odd = left_out(self._search, observed, posterior, gate, known=tracked)
        if odd.failure is not None:
            return odd.failure
        other = odd.other
        if parts is not None:
            other = parts.add(observed, posterior, terms, odd.group, other)
            if parts.part is not part:
                effect = effect_of(parts.part)
        effect = widened(effect, posterior)
        estimate = estimate_of(observed, posterior, best.samples, effect, tracked)
        if odd.surely:
            return altered(estimate, left_out=odd.notice, moved_covariance=other)
        other = estimate.calibration_covariance + other
        return altered(estimate, left_out=odd.notice, calibration_covariance=other)
