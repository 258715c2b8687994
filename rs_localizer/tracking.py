# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tracking from frame to frame: the last motion predicts the next one and is its prior.

A single image shows the camera's velocity only through the shutter, and the linear part badly; two
poses a frame apart show it well. The tracker combines both. Its state is one trajectory through the
last frames (:mod:`rs_localizer.estimation.window`). Accelerations fade within an image or
two while new ones come (Singer, "Estimating optimal tracking filter performance for manned
maneuvering targets", 1970); their size is learnt. The trajectory predicts each frame and is the
prior of its maximum a posteriori estimate. What the points add to the prior joins the window. An
aid that reads how the camera turns, if there is one, replaces the rotation of the motion model; the
window stays the camera's own, and predicts frames that contradict the aid.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import Acceleration, CalibrationErrors, RefinementKind
from rs_localizer.core.arrays import Array, BoolArray, instance, real, whole_ns
from rs_localizer.core.reasons import Reason
from rs_localizer.core.rig import ByCamera, Rig, RigEstimate
from rs_localizer.core.rotation_prior import RotationPrior
from rs_localizer.core.state import (
    ANGULAR,
    LINEAR,
    MOVE,
    PARAMETERS,
    POSE,
    STATE_LINEAR,
    TURN,
    VELOCITIES,
)
from rs_localizer.core.types import Estimate, Failure, altered
from rs_localizer.estimation.calibration import ErrorModes
from rs_localizer.estimation.frames_together import CamerasTogether
from rs_localizer.estimation.known_rotation import Aid, Foretold, LastFrame
from rs_localizer.estimation.moved_part import MovedPart, MovedParts
from rs_localizer.estimation.points import FrameSights
from rs_localizer.estimation.prior import Prior, at_speed, beside, predicted
from rs_localizer.estimation.window import (
    FADING,
    LENGTH,
    MotionSample,
    MotionWindow,
    acceleration_covariance,
    estimate_at,
    gaussian_of,
    predicted_estimate,
    step_from,
    swing_of,
    told_of,
)
from rs_localizer.integrity import Integrity
from rs_localizer.lens_watch import LensWatch
from rs_localizer.localizer import Localizer
from rs_localizer.pace_watch import PaceWatch
from rs_localizer.repeated_images import RepeatedImages, is_clear
from rs_localizer.shutter_watch import FAR_OFF, ShutterWatch
from rs_localizer.solvers.table import find_solver

# After a longer gap (s) a prediction helps less than a fresh search.
_LONGEST_GAP = 1.0
# If this many frames in a row are this close, times are in another unit: ten images per second are
# 100,000 microseconds apart.
_LEAST_STEP_NS, _MOST_TOO_CLOSE = 100_001, 10
# No video has a nanosecond count below this; these are seconds and milliseconds of the years 2001
# to 2096.
_COUNTED, _SINCE_1970 = 1_000_000, ((10**9, 4 * 10**9), (10**12, 4 * 10**12))
# Weight of the newest frame in the share of inliers of the last frames.
_NEWEST = 0.3
# Least part of its inliers that a frame keeps by the motion of all frames: fewer, and they do not
# hang together. No figure of the paired set or of 15 real boards changes by it.
_STILL_FITTING = 0.7
# Largest squared distance of a searched motion from the track: once in a million by chance.
_MOST_INNOVATION = 62.0
# Of the logarithm of the odds of a vibration, the part that the next frame has of it: sizes and
# spectra last for thirty frames, in which a motor is seen that no frame shows.
_REMEMBERED = 0.97
# How fast a camera may be (m/s) that one image takes for slow: it hardly turns, and may be in an
# aircraft. Or faster, in configured deviations.
_FAST, _FASTER = 60.0, 2.0
# Covariance of a motion that is only a first guess.
_UNKNOWN = np.diag(np.full(PARAMETERS, np.inf))
# A frame that jumped is back where the one before the last was if it is nearer to it by this.
_BACK = 0.5
# The least acceleration that a configuration may have, rad/s^2 and m/s^2.
_LEAST_ACCELERATION = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class FrameContext:
    """Knowledge of a frame beside its points."""

    # s; velocities per readout are more uncertain in m/s and rad/s by this.
    readout_time_deviation: float = 0.0
    error_modes: ErrorModes | None = None  # of the map of these points, if it has them


ORDINARY = FrameContext()
"""Context of a frame without other knowledge."""


@dataclass(slots=True)
class _Track:
    """The last frame with a pose, as far as the next one needs it."""

    estimate: Estimate
    time_ns: int
    share: float  # of inliers among the points
    window: MotionWindow
    swing: Array  # (18,18) covariance of the shaking about the window's motion, per readout
    vibrations: Array  # (k,) logarithms of the odds of each vibration, by all frames


@dataclass(slots=True)
class _Seen:
    """One of the last frames."""

    time_ns: int
    found: Estimate | Failure  # by its own fit; later by the window
    sights: FrameSights | None = None  # of a frame that may be published again
    gate: float = 0.0  # px, of inliers; by its own fit, also if it is published again


class Tracker:
    """Localizes the frames of one camera, or of one rig, in their order.

    Args:
        localizer: the localizer of single frames. To remember the motion, its camera must have a
            readout time, because the velocities of one image are per readout. Its solver must be
            for rolling shutters, because a global shutter has no velocities.
        aid: knows from readings how a single camera with a readout time turns; None: nothing does.
        remembers_motion: whether the motion of a frame predicts the next ones.
        output_lag: frames by which results of :meth:`localize` are delayed, so that later frames
            improve them; for a single camera without an aid.
        max_prediction: longest prediction of :meth:`at` after the last frame, s.

    Raises:
        ValueError: without a readout time, with a global-shutter solver, with something else than
            a localizer, or for numbers out of range.
    """

    def __init__(
        self,
        localizer: Localizer,
        aid: Aid | None = None,
        remembers_motion: bool = True,
        output_lag: int = 0,
        max_prediction: float = 0.1,
    ) -> None:
        instance("localizer", localizer, Localizer)
        if aid is not None:
            instance("aid", aid, Aid)
        if remembers_motion:
            _check_motion(localizer)
        elif aid is not None:
            aid.forget_delay()
        if output_lag not in range(LENGTH):
            raise ValueError(f"output_lag must be 0 to {LENGTH - 1} frames, got {output_lag!r}")
        real("max_prediction", max_prediction, "0 s or more", 0.0)
        self.localizer, self.remembers_motion = localizer, remembers_motion
        self.output_lag, self.max_prediction = int(output_lag), max_prediction
        self._seen: deque[_Seen] = deque(maxlen=LENGTH)  # the newest last
        rig, config = localizer.rig, localizer.config
        camera, *others = rig.cameras.values()
        rolls = camera.readout_time > 0.0 and find_solver(config.solver).rolling_shutter
        is_watched = rolls and not others
        self.shutter = ShutterWatch(camera if is_watched else None, config.inlier_threshold)
        self.lens = LensWatch(rig.exposure().ahead() if is_watched else None, config)
        self.pace = PaceWatch(config)
        self._integrity = Integrity(config.acceleration)
        self._parts = MovedParts(config.map_deviation)
        self._last_ns: int | None = None
        self._too_close = 0
        if aid is not None:
            self._readout_time = localizer.camera.readout_time
        self.aid = aid
        self.reset()

    def reset(self) -> None:
        """Forget all frames so far."""
        self._track: _Track | None = None
        self._given: tuple[int, Prior] | None = None
        self._judged_ns: int | None = None
        self._seen.clear()
        self._images = RepeatedImages()
        self.repeats = False  # whether the last frame shows an image that had come before
        for each in (self._integrity, self._parts, self.shutter, self.lens, self.pace):
            each.reset()
        self.cameras = CamerasTogether(self.localizer.rig, self.localizer.config)
        self._allow(self.lens.calibration)
        if self.aid is not None:
            self.aid.reset()

    def stale(self, points: ArrayLike) -> BoolArray:
        """Return a mask of landmarks (n,3) of a single camera, often seen and never matched."""
        return self._integrity.stale(points)

    @property
    def moved(self) -> MovedPart | None:
        """The part of the map that frames of a single camera show elsewhere; None: none.

        What is no larger than smooth errors may be, as of paper that is creased, is allowed for
        only.
        """
        newest = self._seen[-1].found if self._seen else None
        if self.lens.doubted:  # another camera shows all of the map elsewhere
            return None
        return self._parts.named if newest and self.lens.is_beyond(newest) else None

    def mount(self, rig: Rig) -> None:
        """Set new mounts of the same cameras; the rig's axes stay the same."""
        self.localizer = self._allowing = Localizer(rig, self.localizer.config)
        self.cameras = CamerasTogether(rig, self.localizer.config)

    def _trusts_motion(self) -> bool:
        """Return whether motion between frames predicts the motion within one."""
        least = min(camera.readout_time for camera in self.localizer.rig.cameras.values())
        known = self.shutter.error < FAR_OFF * least
        return self.remembers_motion and self.shutter.trusted and known

    def _readout_time_deviation(self, context: FrameContext) -> float:
        """Return the standard deviation (s) of the readout time, as given or as frames show it."""
        return max(context.readout_time_deviation, self.shutter.error)

    def _follows(self, time_ns: int) -> bool:
        """Return whether the motion of the last frame with a pose predicts a time."""
        track = self._track
        return track is not None and 0.0 < (time_ns - track.time_ns) * 1e-9 <= _LONGEST_GAP

    def _has_jumped(self, time_ns: int, prior: Prior | None, result: Estimate | Failure) -> bool:
        """Return whether a frame was found elsewhere than predicted, and farther than cameras go.

        A recording has started over, a robot was moved, or the frames before were wrong.
        """
        track, most = self._track, self.localizer.config.velocity_prior
        if track is None or prior is None or prior.motion is None or not result or result.tracked:
            return False
        step, seconds = step_from(track.estimate, result), 1e-9 * (time_ns - track.time_ns)
        return any(
            0.0 < limit * seconds < np.linalg.norm(step[part])
            for limit, part in ((most.angular, TURN), (most.linear, MOVE))
        )

    def _checked(self, time_ns: int) -> int:
        """Return a time as Python's integer; ``ValueError``: it cannot be in nanoseconds."""
        time_ns = whole_ns(time_ns)
        before, self._last_ns = self._last_ns, time_ns
        step = _LEAST_STEP_NS if before is None else time_ns - before
        self._too_close = self._too_close + 1 if 0 < step < _LEAST_STEP_NS else 0
        # One pair is enough for seconds or milliseconds since 1970, or milliseconds since the
        # start, of images within ten seconds: nanoseconds since the boot can look alike.
        coarse = time_ns < _COUNTED or any(low <= time_ns < high for low, high in _SINCE_1970)
        if self._too_close >= (1 if coarse and step < 10_000 else _MOST_TOO_CLOSE):
            raise ValueError(
                f"frames are {step} ns apart: time_ns is in nanoseconds, 1e9 of a second, 1e6 of "
                "a millisecond and 1e3 of a microsecond"
            )
        return time_ns

    def expect(self, time_ns: int, prior: Prior) -> None:
        """Let the frame at this time be found near a motion that others know.

        It is ignored if the frames before predict the motion, which they know better.
        """
        instance("prior", prior, Prior)
        self._given = whole_ns(time_ns), prior

    def prediction(
        self, time_ns: int, span: float | None = None, context: FrameContext = ORDINARY
    ) -> Prior | None:
        """Predict the motion at a time from the last frames or others; None if nothing is known.

        ``span`` is the time (s) of the frame's rows; None: that of the last frame.
        """
        track, time_ns = self._track, whole_ns(time_ns)
        if track is None or not self._follows(time_ns):
            given = self._given
            return given[1] if given is not None and given[0] == time_ns else None
        own = track.estimate.span
        share = self._readout_time_deviation(context) / own
        foreseen = track.window.foreseen(time_ns, share)
        motion, covariance = foreseen.per_readout(own if span is None else span)
        return predicted(motion, covariance + track.swing)

    def at(self, time_ns: int, readings: Any = None) -> Estimate | None:
        """Return the motion at a time, in ns as :meth:`localize` takes it.

        Within the rows of one of the last frames it is the motion of that frame. Between frames it
        comes from the frames before and after. After them it is predicted. Before the last frames,
        more than ``max_prediction`` after them, or if the orientation is too uncertain, it is None.
        Points are those of the nearest frame.

        Args:
            time_ns: the time, ns.
            readings: of the aid, from before the last frame with a pose until now; after that
                frame, the camera rotates as they say.
        """
        track, time_ns = self._track, whole_ns(time_ns)
        if track is None:
            return None
        # Of frames that failed since there may be more than are kept.
        frames = [*((seen.time_ns, seen.found) for seen in self._seen if seen.found)]
        frames.append((track.time_ns, track.estimate))
        # Later than the track, images that rest have come.
        if (time_ns - max(frames, key=lambda frame: frame[0])[0]) * 1e-9 > self.max_prediction:
            return None
        nearest_ns, nearest = min(frames, key=lambda frame: abs(frame[0] - time_ns))
        assert isinstance(nearest, Estimate)
        seconds = 1e-9 * (time_ns - nearest_ns)
        if abs(seconds) <= 0.5 * nearest.span:
            there = Estimate.at_time(nearest, seconds)
        elif time_ns > track.time_ns and (turned := self.turned(time_ns, readings)) is not None:
            there = turned
        else:
            motion = track.window.at(time_ns)
            if motion is None:
                return None
            there = predicted_estimate(nearest, motion, track.swing)
        there = replace(there, time_ns=time_ns)
        if isinstance(there, RigEstimate):
            there = replace(there, time=there.time + seconds)
        return there if self._accepted(there) else None

    def snapshot(self) -> Tracker:
        """Return a copy, made between two frames, for :meth:`at` in another thread."""
        there = copy(self)
        there._seen = deque(map(copy, self._seen), LENGTH)
        there._track = copy(self._track)
        if self.aid is not None:
            there.aid = self.aid.snapshot()
        return there

    def turned(self, time_ns: int, readings: Any) -> Estimate | None:
        """Return the motion before or after the rows of the last frame, rotated by the aid.

        None where no readings tell it.
        """
        track = self._track
        if track is None or self.aid is None or not self.aid.agreed or not readings:
            return None
        span, half_ns = track.estimate.span, round(0.5e9 * track.estimate.span)
        # The rows of the last frame are known, too.
        last_ns = max(self.aid.last_ns(readings), track.time_ns + half_ns)
        seen_ns = min(time_ns, last_ns)
        # The middle of a frame whose last row would be there.
        middle_ns = min(time_ns, last_ns - half_ns)
        if middle_ns < track.time_ns <= time_ns or time_ns > last_ns + half_ns:
            return None
        last = track.estimate
        if middle_ns != track.time_ns:
            before = self._before(middle_ns)
            known = None if before is None else self.aid.ahead(readings, middle_ns, before)
            if known is None:
                return None
            last = known.of(last)
        there = last.at_time(1e-9 * (seen_ns - middle_ns))
        if (unseen := 1e-9 * (time_ns - seen_ns)) > 0.0:
            there, variance = there.at_time(unseen), self.aid.changed(readings, unseen)
            added = acceleration_covariance(self._beside_aid(track), unseen, span)
            added[ANGULAR, ANGULAR] += span**2 * variance * np.eye(3)
            added[TURN, TURN] += unseen**2 * variance * np.eye(3)
            there = replace(there, joint_covariance=there.joint_covariance + added)
        return there

    def flush(self) -> list[Estimate | Failure]:
        """Return the results that ``output_lag`` still holds back, at the end of a recording."""
        held = list(self._seen)[max(len(self._seen) - self.output_lag, 0) :]
        self._seen.clear()
        return [self._accepted(seen.found) for seen in held]

    def _accepted(self, found: Estimate | Failure) -> Estimate | Failure:
        """Return the estimate, or the reason why it is not published."""
        if found and self.shutter.refusal:
            return Failure(Reason.SCAN_AXIS, self.shutter.refusal)
        if found and self.lens.refusal:
            return Failure(Reason.CALIBRATION, self.lens.refusal)
        return self.localizer.accepted(found)

    def localize(
        self,
        time_ns: int,
        points: ArrayLike | Mapping[str, Sequence[ArrayLike]],
        pixels: ArrayLike | None = None,
        scores: ArrayLike | None = None,
        *,
        readings: Any = None,
        stamps: Mapping[str, float] | None = None,
        context: FrameContext = ORDINARY,
    ) -> Estimate | Failure:
        """Localize the frame whose middle row was exposed at ``time_ns``.

        Arguments, result and errors are otherwise as of :meth:`Localizer.localize`. A time that
        does not follow the last one (a bag that starts over) or a gap of a second ends the track.
        Pixels that repeat the last image, bit for bit, count once; if the camera has moved since,
        they are refused. :attr:`repeats` is then true.

        Args:
            readings: of the aid, from before the last frame with a pose, if there are any, until
                after the exposure of this one; None: the camera goes alone.
            stamps: of a rig, s after ``time_ns`` at which the first rows were exposed (None: then);
                the time of the estimate counts from there, too.
            context: what else is known of this frame.
        """
        instance("context", context, FrameContext)
        later, span = 0, None
        if isinstance(points, Mapping) and points:
            exposure = self.localizer.rig.exposure(tuple(points), stamps)
            later, span = round(1e9 * exposure.time), exposure.span
        if self.remembers_motion:
            time_ns = self._checked(time_ns) + later
            if not self._follows(time_ns):
                self._track = None
        elif self.aid is not None:
            self.aid.reset()
        again = self._again(time_ns, points, pixels, readings)
        if again is not None:
            self._keep(_Seen(time_ns, again))
            return self.delayed
        sights = self.localizer.sights(points, pixels, scores, stamps)
        share = 0.0 if self._track is None else self._track.share
        modes = self.lens.errors_of(context.error_modes)

        def find(prior: Prior | None, rotation: RotationPrior | None) -> Estimate | Failure:
            return self._allowing.find(sights, prior, share, rotation, modes, self._parts)

        foreseen = None
        if self.aid is not None:
            foreseen = self.aid.foresee(readings, time_ns, self._before(time_ns))
        result, prior, told = self._fitted(time_ns, foreseen, span, context, find)
        if pixels is not None:  # of a camera alone
            seen = sights.points, sights.pixels
            self._watch(time_ns, result, prior, sights)
        elif result and self.remembers_motion:
            self.cameras.add(result, self.localizer.known_of(None, result.span), sights)
            result = self.cameras.widened(result)
        if result:
            if pixels is not None:
                result = self._judged(time_ns, result, seen[0], prior)
                result = self.lens.widened(result, *seen)
            result = self.shutter.widened(result)
            if self.remembers_motion:
                result = self._covering(altered(result, time_ns=time_ns))
                self._remember(time_ns, told, result, context)
        self._keep(_Seen(time_ns, result, sights))
        self._images.add(time_ns, points, pixels)
        self._publish()
        return self.delayed

    def _watch(
        self, time_ns: int, result: Estimate | Failure, prior: Prior | None, sights: FrameSights
    ) -> None:
        """Compare a frame of a camera alone with the last ones."""
        jumped = self._has_jumped(time_ns, prior, result)
        if result:
            self._compare_pace(time_ns, result, jumped, sights)
        if self.pace.fault:  # neighbours are of two cameras, or in another unit
            self.lens.reset()
        else:
            self.lens.add(time_ns, result, sights.points, sights.pixels, jumped=jumped)
        self._allow(self.lens.calibration)
        if self.lens.matrix is None:
            self.shutter.add(time_ns, result, sights, jumped=jumped)
        doubtful = self.shutter.error or not self.shutter.trusted
        if doubtful and self.remembers_motion:  # alone, frames may have any velocities
            self._parts.discard()

    def _compare_pace(
        self, time_ns: int, result: Estimate, jumped: bool, sights: FrameSights
    ) -> None:
        """Compare a pose with those before it, which may alternate, or move impossibly."""
        away, before = None, self._seen[-2].found if len(self._seen) > 1 else None
        if jumped and self._track is not None and before:
            step, back = (step_from(one, result)[POSE] for one in (self._track.estimate, before))
            away = step if np.linalg.norm(back) < _BACK * np.linalg.norm(step) else None
        self.pace.returns(away)

        def alone() -> Estimate | Failure:
            held_back = self.lens.is_beyond(result) or self.pace.is_odd
            if not (result.tracked and held_back):
                return result
            return self.localizer.accepted(self.localizer.find(sights))

        self.pace.add(time_ns, result, sights.points, alone)

    def _allow(self, calibration: CalibrationErrors) -> None:
        """Let the next frames have these deviations."""
        self._allowing = self.localizer
        if calibration != self.localizer.config.calibration:
            self._allowing = copy(self.localizer)
            self._allowing.config = replace(self.localizer.config, calibration=calibration)

    def _fitted(
        self, time_ns: int, foreseen: Foretold | None, span: float | None,
        context: FrameContext,
        find: Callable[[Prior | None, RotationPrior | None], Estimate | Failure],
    ) -> tuple[Estimate | Failure, Prior | None, MotionSample | None]:  # fmt: skip
        """Find the frame beside what the aid knows, or without what its points contradict.

        Returns:
            what was found, the prior that it was found with, and what its points tell.
        """
        aided: tuple[Estimate | Failure, Prior | None, MotionSample | None] | None = None
        if foreseen is not None and self.aid is not None and not self.aid.contradicted:
            rotation = foreseen.rotation
            prior = foreseen.prior or self._prior(time_ns, rotation, span, context)
            found = find(prior, rotation)
            told = self._told(time_ns, found, prior, rotation)
            aided = found, prior, told
            # Far from where it was expected, a frame before a plane agrees with any rotation.
            free = foreseen.prior is None or foreseen.prior.motion is None
            if found and told is not None and (free or found.tracked):
                if self.aid.agrees(foreseen, found, told):
                    return aided
                foreseen = None  # and is judged
        alone = self._prior(time_ns, None, span, context)
        other = find(alone, None)
        if not other and aided is not None:
            return aided
        told = self._told(time_ns, other, alone, None)
        if other and told is not None and foreseen is not None and self.aid is not None:
            agrees = self.aid.agrees(foreseen, other, told)
            if agrees and aided is not None and aided[0] and aided[2] is not None:
                return aided
        return other, alone, told

    def _told(
        self, time_ns: int, found: Estimate | Failure, prior: Prior | None,
        rotation: RotationPrior | None,
    ) -> MotionSample | None:  # fmt: skip
        """Return what the points of a frame tell of its motion beside what was known of it.

        None if nobody asks for it, or if rounding errors are all that is left of a covariance.
        """
        if not found or not (self.remembers_motion or self.aid is not None):
            return None
        known = self.localizer.known_of(prior if found.tracked else None, found.span, rotation)
        if not (found.tracked or found.twist_known):
            speed = self._possible_speed() * found.span
            found, known = _as_fast(found, speed), at_speed(known, speed)
        try:
            return told_of(found, time_ns, known, rotation)
        except np.linalg.LinAlgError:
            return None

    def _keep(self, seen: _Seen) -> None:
        if self._seen and self._seen[-1].time_ns == seen.time_ns:  # the same frame, matched anew
            self._seen.pop()
        if isinstance(seen.found, Estimate):
            fitted = seen.found.residuals[seen.found.inliers].max(initial=0.0)
            seen.gate = max(self.localizer.config.inlier_threshold, fitted)
        self._seen.append(seen)

    def _again(
        self, time_ns: int, points: Any, pixels: Any, readings: Any
    ) -> Estimate | Failure | None:
        """Return the result of a frame that repeats the last image; None if it does not.

        A camera that has moved since cannot have seen it. If the camera rests, the image adds no
        information: the track stays as it was.
        """
        copies = self._images.copies(points, pixels) if self.newest_ns != time_ns else []
        self.repeats, track = bool(copies), self._track
        if copies and track is not None and self._has_left(track, time_ns, readings):
            self._images.judge(copies, track.time_ns)
        if stale := self._images.stale(copies):
            of = f" of {', '.join(stale)}" if any(stale) else ""
            return Failure(
                Reason.REPEATED_IMAGE,
                f"the pixels{of} are those of an earlier image, bit for bit, and the camera has "
                "moved since",
            )
        found = self._seen[-1].found if self._seen else None
        if track is None or not found or not self._images.are_all(points, pixels):
            return None
        return replace(found, time_ns=time_ns) if self.remembers_motion else found

    def _has_left(self, track: _Track, time_ns: int, readings: Any) -> bool:
        """Return whether the camera has surely moved since the last pose, by aid or velocities.

        What accelerations may change is no doubt of that: a camera that rests then and now has
        none.
        """
        known, pose = None, track.estimate.joint_covariance[POSE, POSE]
        if self.aid is not None and self.aid.agreed and readings:
            before = self._before(time_ns)
            known = None if before is None else self.aid.ahead(readings, time_ns, before)
        if known is not None and known.prior is not None and known.prior.motion is not None:
            there, spread = known.prior.motion, np.asarray(known.prior.covariance)[POSE, POSE]
            return is_clear(step_from(track.estimate, there)[POSE], pose + spread)
        last = track.window.newest
        if len(track.window) == 1:  # an image shows what it shows, however fast a camera may be
            last = gaussian_of(track.estimate, track.time_ns)
        motion, covariance = last.per_readout(track.estimate.span)
        readouts = 1e-9 * (time_ns - track.time_ns) / track.estimate.span
        step = readouts * np.r_[motion.angular_velocity, motion.linear_velocity]
        return is_clear(step, pose + readouts**2 * covariance[VELOCITIES, VELOCITIES])

    @property
    def newest(self) -> Estimate | Failure | None:
        """The result of the last frame, whatever ``output_lag`` is; None before any."""
        return self._accepted(self._seen[-1].found) if self._seen else None

    @property
    def newest_ns(self) -> int | None:
        """When the middle row of the last frame was exposed; None before any."""
        return self._seen[-1].time_ns if self._seen else None

    @property
    def delayed(self) -> Estimate | Failure:
        """The result of the frame ``output_lag`` before the last one."""
        if len(self._seen) > self.output_lag:
            return self._accepted(self._seen[-1 - self.output_lag].found)
        return Failure(
            Reason.AWAITS_FRAMES,
            f"output_lag is {self.output_lag} frames, of which {len(self._seen) - 1} have come",
        )

    def _publish(self) -> None:
        """Give the last frames the motion that the window knows of them."""
        if self._track is None or len(window := self._track.window) < 2:
            return
        known = {time_ns: k for k, time_ns in enumerate(reversed(window.times))}
        for seen in list(self._seen)[-1 - self.output_lag :]:
            if not (seen.found and seen.sights) or seen.found.aided or seen.time_ns not in known:
                continue
            found = estimate_at(seen.found, window.before(known[seen.time_ns]))
            residuals = seen.sights.residuals(found)
            if isinstance(found.residuals, ByCamera):
                residuals = found.residuals.like(residuals)
            inliers = residuals <= seen.gate
            if np.count_nonzero(inliers) >= _STILL_FITTING * np.count_nonzero(found.inliers):
                seen.found = altered(found, residuals=residuals, inliers=inliers)
            elif seen.time_ns == self._track.time_ns:
                self._track.window = self._alone(seen.found, window.readout_share, window)

    def _covering(self, result: Estimate) -> Estimate:
        """Return the estimate with velocities as uncertain as frames show them, if rows may not.

        Rows of a readout time that nobody knows may all have been exposed at once: then they show
        no motion, however fast the camera is.
        """
        track = self._track
        seconds = 0.0 if track is None else 1e-9 * (result.time_ns - track.time_ns)
        if track is None or self._trusts_motion() or not seconds > 0.0:
            return result
        off = -result.span / seconds * step_from(result, track.estimate)[POSE]
        off -= np.concatenate([result.angular_velocity, result.linear_velocity])
        joint = result.joint_covariance.copy()
        joint[VELOCITIES, VELOCITIES] += np.outer(off, off)
        if self.shutter.is_global:  # rows say nothing of how that has changed since
            capable = self.localizer.config.acceleration
            changed = acceleration_covariance(capable, seconds, result.span)
            joint[VELOCITIES, VELOCITIES] += changed[VELOCITIES, VELOCITIES]
        return replace(result, joint_covariance=joint)

    def _judged(
        self, time_ns: int, result: Estimate, points: Array, prior: Prior | None
    ) -> Estimate:
        """Return the estimate with its integrity; without a covariance it has none."""
        if np.isnan(result.joint_covariance[0, 0]):
            return result
        seconds = 0.0 if self._track is None else 1e-9 * (time_ns - self._track.time_ns)
        numbers = self._integrity.numbers(result, points, prior, seconds)
        before, self._judged_ns = self._judged_ns, time_ns  # of images that have no track, too
        gone = time_ns - before if before is not None else 0
        later = 1e-9 * gone if gone > 0 else math.inf
        return altered(result, integrity=self._integrity.add(numbers, later))

    def _prior(
        self, time_ns: int, rotation: RotationPrior | None, span: float | None,
        context: FrameContext,
    ) -> Prior | None:  # fmt: skip
        """Return the prior of a frame for which an aid predicts only the rotation."""
        if not self.remembers_motion:
            return Prior(of_rest=self.shutter.of_rest) if rotation is None else None
        prior = self.prediction(time_ns, span, context)
        if prior is not None and not self._trusts_motion():
            rest = self.shutter.of_rest if rotation is None else 0.0
            prior = replace(prior, covariance=_UNKNOWN, of_rest=rest)
        if rotation is None:
            if prior is not None and self._track is not None:
                prior = altered(prior, of_vibration=self._track.vibrations)
            return prior
        return None if prior is None else beside(prior, rotation)

    def _remember(
        self, time_ns: int, told: MotionSample | None, result: Estimate, context: FrameContext
    ) -> None:
        """Keep what the next frames are to know of this one."""
        track, share, vibrations = self._track, float(result.inliers.mean()), result.vibrations
        if track is not None and result.tracked:
            share = (1.0 - _NEWEST) * track.share + _NEWEST * share
        if track is not None and track.vibrations.size:
            # Beside an aid they are of another kind: of what it leaves.
            is_new = vibrations.size and not result.aided
            vibrations = track.vibrations + (vibrations if is_new else 0.0)
        window, swing = self._window(time_ns, told, result, context), swing_of(result)
        self._track = _Track(result, time_ns, share, window, swing, _REMEMBERED * vibrations)

    def _window(
        self, time_ns: int, told: MotionSample | None, result: Estimate, context: FrameContext
    ) -> MotionWindow:
        """Return a window of the last frames and this one; if it denies them, of this one alone."""
        track, share = self._track, self._readout_time_deviation(context) / result.span
        if track is not None and told is not None and self._trusts_motion():
            window = replace(track.window, readout_share=share).joined(told)
            # Less than 0, beside rounding errors, is left where the slope of a prior that is far
            # behind is no Gaussian's. NaN, of rounding errors, is neither.
            if -1.0 < window.surprise < _MOST_INNOVATION:
                return window
        return self._alone(result, share, None if track is None else track.window)

    def _alone(
        self, result: Estimate, readout_share: float, before: MotionWindow | None
    ) -> MotionWindow:
        """Return the window of a frame that those before it do not predict."""
        start = gaussian_of(_as_fast(result, self._fastest * result.span), result.time_ns)
        alone = MotionWindow.begin(start, self.localizer.config.acceleration, readout_share)
        return alone if before is None else replace(alone, deviations=before.deviations)

    @property
    def _fastest(self) -> float:
        """How fast (m/s) a camera may be that one image takes for slow."""
        configured = self.localizer.config.velocity_prior.linear
        return max(_FAST, _FASTER * configured) if configured > 0.0 else 0.0

    def _possible_speed(self) -> float:
        """Return how fast (m/s) the track is, as far as anybody knows."""
        track = self._track
        if track is None or len(track.window) == 1:
            return self._fastest
        return float(np.linalg.norm(track.window.newest.state[STATE_LINEAR]))

    def _beside_aid(self, track: _Track) -> Acceleration:
        """Return the accelerations beside the rotation that an aid reads."""
        linear = max(float(track.window.deviations[3]), _LEAST_ACCELERATION)
        return Acceleration(_LEAST_ACCELERATION, linear)

    def _before(self, time_ns: int) -> LastFrame | None:
        """Return what the last frame knows of the motion beside the rotation that an aid reads.

        Before that frame the motion runs backwards: velocities are opposite, accelerations are not.
        """
        track = self._track
        if track is None:
            return None
        readout_time = self._readout_time
        motion, dt = track.estimate, 1e-9 * (time_ns - track.time_ns)
        covariance = motion.joint_covariance[:PARAMETERS, :PARAMETERS]
        added = acceleration_covariance(self._beside_aid(track), abs(dt), readout_time)
        added[VELOCITIES] *= math.copysign(1.0, dt)
        added[:, VELOCITIES] *= math.copysign(1.0, dt)
        fading = math.copysign(FADING, dt) / readout_time
        return LastFrame(track.time_ns, motion, covariance, added, fading)


def _as_fast(found: Estimate, speed: float) -> Estimate:
    """Return an estimate that may be faster by ``speed``, m per readout: its rows hardly tell."""
    joint = found.joint_covariance.copy()
    joint[LINEAR, LINEAR] += speed**2 * np.eye(3)
    return replace(found, joint_covariance=joint)


def _check_motion(localizer: Localizer) -> None:
    """Raise ``ValueError`` where frames do not say how the camera moves."""
    cameras = localizer.rig.cameras.values()
    if not all(camera.readout_time > 0.0 for camera in cameras):
        raise ValueError("tracking needs the readout time of the camera, which is 0 (unknown)")
    if localizer.config.refinement != RefinementKind.FULL:
        raise ValueError(f"tracking needs refinement full, got {localizer.config.refinement}")
    if not find_solver(localizer.config.solver).rolling_shutter:
        raise ValueError(
            f"tracking needs velocities, which solver {localizer.config.solver} does not find"
        )
