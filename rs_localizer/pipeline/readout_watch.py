# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The readout time that the camera's own motion shows, beside the one that is set."""

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.config import LONGEST_READOUT_TIME, NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.core.shake import FUNCTIONS, shake_at
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.clouds import Correspondences
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.readout_estimate import MeasuredReadout, ReadoutEstimate
from rs_localizer.pipeline.refusal import Notify
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import FAR_OFF

_OTHER_AXIS = {
    ScanDirection.TOP_TO_BOTTOM: ScanDirection.LEFT_TO_RIGHT,
    ScanDirection.BOTTOM_TO_TOP: ScanDirection.RIGHT_TO_LEFT,
    ScanDirection.LEFT_TO_RIGHT: ScanDirection.TOP_TO_BOTTOM,
    ScanDirection.RIGHT_TO_LEFT: ScanDirection.BOTTOM_TO_TOP,
}
# Logarithm of the likelihood ratio that one frame may contribute: errors of map and lens make a
# few of either sign in single frames (at most 13 in 360 simulated ones with the right axis, where
# the wrong one has a median of 5 to 160), and none shall decide alone.
_MOST_OF_A_FRAME = 4.0
# Of the sum, what is left one frame later: of two seconds at 30 Hz, a seventh.
_MEMORY = 0.97
# Odds of e^12 are enough to act, if the motion agrees; e^3 to doubt. Of odds the other way no more
# than e^4 is remembered: a camera that rests says little, and may start to move.
_CERTAIN, _DOUBT, _LEAST = 12.0, 3.0, -4.0
# Frames that are tried at the beginning; of others, every so many, as long as nothing speaks for
# the other axis.
_TRIED_FIRST, _EVERY = 5, 10
# Odds (logarithms) that motion along the other axis agrees, or does not.
_AGREES, _CONTRADICTS = 4.6, 2.0
# A readout time along the other axis counts when it is known to a twelfth, and more than half of
# the one that is set: of a real global shutter with errors of its lens, 5.1 +- 1.2 and 32.8 +- 3.0
# ms of 20 were seen.
_KNOWN, _LEAST_SHARE = 0.08, 0.5
# Triples of frames from which on a measurement counts: fewer have no scatter worth the name.
_LEAST_TRIPLES = 20
# Residuals count up to this multiple of the inlier threshold.
_TRUNCATED = 2.0
_LEAST_NOISE = 0.1  # px
# What an in-frame turn fits of noise at most, as a logarithm of a likelihood ratio: half a unit for
# each of its functions, about both axes of the image; and no more than it moves the points.
# Without it the wrong axis, which always needs one, won by 4 to 22 for half a second of a hand's
# motion (frames 617 to 631 of the bundled one).
_OF_TURNS = float(FUNCTIONS)


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """A frame as it was localized."""

    time_ns: int  # when its middle row was exposed
    cloud: Correspondences
    result: Estimate | Failure
    config: NodeConfig  # by which it was localized
    camera: Camera

    def tell(self, estimate: ReadoutEstimate) -> MeasuredReadout | None:
        """The readout time with this frame, which has a pose."""
        assert self.result
        seen = self.cloud.points, self.cloud.pixels
        estimate.add(self.time_ns, self.camera, self.result, *seen)
        return estimate.measured

    def cost(self, most: float, noise: float) -> float:
        """Negative logarithm of the likelihood; residuals (px) are cut off at ``most``."""
        result, pixels = self.result, self.cloud.pixels
        if not result:
            return len(pixels) * most**2 / (2.0 * noise**2)
        cut = np.fmin(result.residuals, most)  # NaN: unusable along either axis
        turns = shake_at(self.camera.row_time(pixels[result.inliers]), result.shake)[:, :2]
        moved = float(np.sum((self.camera.focal_length * turns) ** 2)) / (2.0 * noise**2)
        return float(cut @ cut) / (2.0 * noise**2) + min(moved, _OF_TURNS)


class ScanAxis:
    """Odds that the shutter moves over columns where rows are set, or over rows.

    Drivers that rotate images turn the scan sideways and say nothing of it. The axis that is set
    and the other one are compared by what their motions leave of each frame, until one of them is
    certain; the direction along the other one comes from its motions from frame to frame.
    """

    def __init__(self) -> None:
        self._localizers: tuple[Localizer, Localizer] | None = None  # by this axis, by the other
        self._estimate = ReadoutEstimate()
        self._odds = 0.0  # logarithm, of the other axis
        self._moves = 0.0  # likewise, that its motions agree from frame to frame
        self._enough = _CERTAIN  # odds that make it wrong; until as much speaks against it
        self._frames, self._confirmed = 0, False
        # What the last frame is by the other axis, if that may be the right one.
        self.other: Estimate | None = None
        # Along the other axis: how long the readout takes (positive), and its direction.
        self.measured: MeasuredReadout | None = None
        self.direction: ScanDirection | None = None

    @property
    def doubtful(self) -> bool:
        """True while frames fit the other axis better: errors of map and lens may do it, too."""
        return self._odds > _DOUBT and not self._contradicted

    @property
    def _contradicted(self) -> bool:
        return self.direction is None and self._moves < -_CONTRADICTS

    @property
    def wrong(self) -> bool:
        """True if it must be the other axis: its motions also agree from frame to frame."""
        agrees = self.direction is not None or self._moves > _AGREES
        return agrees and self._odds > self._enough

    def confirm(self) -> None:
        """Look no more: the motion along the axis that is set agrees from frame to frame."""
        self._confirmed = self._odds <= _DOUBT

    def add(self, frame: Watched) -> None:
        """Compare a frame."""
        self._frames += 1
        self.other = None
        # The wrong axis makes in-frame turns, and refusals.
        odd = not frame.result or len(frame.result.shake) > 0
        due = self._odds > _DOUBT or (odd and self._odds > _LEAST)
        due |= self._frames <= _TRIED_FIRST or self._frames % _EVERY == 0
        if self._confirmed or not due:
            return
        cloud, config = frame.cloud, frame.config
        if self._localizers is None:
            other = _OTHER_AXIS[ScanDirection(config.scan_direction)]
            sideways = replace(frame.camera, scan_direction=other)
            self._localizers = Localizer(frame.camera, config), Localizer(sideways, config)
        # Alone both: what other frames or a gyroscope know of a motion is no fit of this one's
        # noise, of which a free motion takes some 4 units of the logarithm more.
        alone = [
            replace(
                frame, camera=it.camera, result=it.find(cloud.points, cloud.pixels, cloud.scores)
            )
            for it in self._localizers
        ]
        found = alone[1].result
        rms = [it.result.residual_rms for it in alone if it.result]
        noise = max(min(rms, default=math.inf) / math.sqrt(2.0), _LEAST_NOISE)
        ours, others = (it.cost(_TRUNCATED * config.inlier_threshold, noise) for it in alone)
        ratio = min(max(ours - others, -_MOST_OF_A_FRAME), _MOST_OF_A_FRAME)
        self._odds = max(_MEMORY * self._odds + ratio, _LEAST)
        if found and self._odds > _DOUBT:
            self._measure(alone[1])
        known = self.direction is not None
        self._enough = 0.0 if known and self.wrong else _CERTAIN
        if found and self._odds > 0.0 and not self._contradicted:
            self.other = found

    def _measure(self, frame: Watched) -> None:
        measured, usual = frame.tell(self._estimate), frame.camera.readout_time
        if measured is None:
            return
        self._moves = max(measured.odds(value, 0.0) for value in (usual, -usual))
        if measured.triples < _LEAST_TRIPLES or not measured.contradicts(0.0):
            return
        large = abs(measured.readout_time) > _LEAST_SHARE * usual
        if large and measured.relative_deviation < _KNOWN:
            direction = ScanDirection(frame.camera.scan_direction)
            self.measured = replace(measured, readout_time=abs(measured.readout_time))
            self.direction = direction if measured.readout_time > 0.0 else REVERSED[direction]


# A value is adopted when it is known to this share of itself, by so many frames.
_WELL_KNOWN, _ENOUGH = 0.02, 60
# So many deviations below zero, rows run the other way.
_SURELY = 4.0
# Of the setting: from here on nothing tells the shutter from a global one.
_GLOBAL = 0.2
# Logarithms of odds: of a global shutter or a reversed one that are enough to doubt, and those for
# the setting that end the doubt. A robot that drives slowly shows neither: by 2 of both, one in
# four of such drives was doubted by chance, for ever.
_SUSPICIOUS, _SHOWN = 4.0, 2.0
# Those of a global shutter to be certain; and what is then said of rest.
_ALL_BUT_SURE, _AT_REST = math.log(100.0), math.log(1e9)
# A shaken camera turns differently between its frames than within them, whatever its shutter: then
# at no readout time squared errors are those of noise.
_MOST_MISFIT = 1.5


# What may be wrong about a readout time; each is said once.
_DURATION, _REVERSED, _GLOBAL_SHUTTER, _AXIS = "duration", "reversed", "global shutter", "axis"


class ReadoutWatch:
    """Measures the readout time while frames are localized, and says when it contradicts.

    Args:
        notice: told of a contradiction, once of each kind until :meth:`reset`, and of a value that
            is adopted; by the name ``readout_time`` and one sentence.
    """

    def __init__(self, notice: Notify) -> None:
        self._notice = notice
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._estimate, self.axis = ReadoutEstimate(), ScanAxis()
        self._said: set[str] = set()
        # What the last seconds of motion showed; None: nothing yet.
        self.measured: MeasuredReadout | None = None
        self.fault = ""  # how that contradicts the setting, in one sentence
        # s, how far it says that the setting is off, for velocities that divide by it; 0: not.
        self.error = 0.0
        # Whether the setting is wrong by so much that what the camera does from frame to frame
        # says nothing of what it does within them: a global shutter, or a reversed one. Once it
        # was, doubts are not enough.
        self.far_off = False
        # Whether, of these, the shutter is a global one; and whether this leaves nothing but noise:
        # one that shakes by more than half the rate of its images looks like it otherwise.
        self.global_shutter = self.surely_global = False
        # Whether rows may run the other way: then an image begins where it is said to end.
        self.may_be_reversed = False
        # Whether what the camera does from frame to frame tells what it does within them: after a
        # doubt not before frames show it. To and fro between both, poses jump.
        self.trusted = True

    @property
    def wrong_axis(self) -> str:
        """Reason to publish no pose, as the shutter moves along the other axis; empty: none."""
        if self.axis.wrong and self.axis.direction is None:
            return "the image fits a shutter along the other axis better than scan_direction"
        return self.fault if self.axis.wrong else ""

    @property
    def of_rest(self) -> float:
        """Logarithm of the odds that what looks like motion within an image is none."""
        return _AT_REST if self.global_shutter else 0.0

    def add(self, frame: Watched) -> NodeConfig:
        """Take a frame.

        Returns:
            its settings, with the readout time and scan direction that were measured where they
            ask for it.
        """
        config, axis = frame.config, self.axis
        estimates = config.estimate_readout_time and config.readout_time == 0.0
        wanted = estimates or config.readout_time > 0.0
        if not (wanted and find_solver(config.solver).rolling_shutter):
            return config
        axis.add(frame)
        self.trusted &= not (axis.doubtful and axis.other)
        if axis.wrong and axis.direction is not None:
            return self._other_axis(config, estimates)
        if not frame.result:
            return config
        measured = frame.tell(self._estimate)
        if axis.doubtful or measured is None:
            return config
        if measured.triples >= _LEAST_TRIPLES:
            self.measured = measured
        if estimates:
            return self._adopt(config, measured, ScanDirection(config.scan_direction))
        self._judge(config, measured)
        return config

    def _other_axis(self, config: NodeConfig, estimates: bool) -> NodeConfig:
        """Say that the shutter moves along the other axis, or adopt it."""
        measured, direction = self.axis.measured, self.axis.direction
        assert measured is not None
        assert direction is not None
        value = _milliseconds(abs(measured.readout_time), measured.deviation)
        self._contradict(
            _AXIS,
            f"the image shows a shutter that moves {direction} in {value}, not "
            f"{config.scan_direction}; no poses are published until scan_direction is {direction}",
        )
        return self._adopt(config, measured, direction) if estimates else config

    def _judge(self, config: NodeConfig, measured: MeasuredReadout) -> None:
        """Judge whether the setting is contradicted, and by what."""
        usual, found = config.readout_time, measured.readout_time
        of_global, of_reversed = (measured.odds(value, usual) for value in (0.0, -usual))
        doubt = max(of_global, of_reversed)
        sure = measured.misfit < _MOST_MISFIT and (
            min(of_global, measured.odds(0.0, -usual)) > _ALL_BUT_SURE
        )
        enough = measured.triples >= _LEAST_TRIPLES
        wrong, self.fault = _verdict(config, measured, sure) if sure or enough else ("", "")
        if wrong:
            self._contradict(wrong, self.fault)
        off = math.hypot(found - usual, measured.deviation)
        shorter = usual / max(abs(found), _GLOBAL * usual, measured.deviation)
        self.error = off * max(shorter, 1.0) if wrong else 0.0
        # A global shutter may be no worse.
        self.far_off = found < FAR_OFF * usual and (self.far_off or bool(wrong))
        self.global_shutter = self.far_off and (
            wrong == _GLOBAL_SHUTTER if wrong else self.global_shutter
        )
        self.surely_global = self.global_shutter and (self.surely_global or sure)
        doubtful = doubt > _SUSPICIOUS and not self.fault
        self.may_be_reversed = of_reversed > 0.0 and (
            doubtful or (self.far_off and not self.global_shutter)
        )
        if self.far_off or doubtful:
            self.trusted = False
        elif doubt < -_SHOWN:
            self.trusted = True
        if enough and found - _SURELY * measured.deviation > FAR_OFF * usual:
            self.axis.confirm()

    def _contradict(self, kind: str, text: str) -> None:
        self.fault = text
        if kind not in self._said:
            self._said.add(kind)
            self._notice(Notice.READOUT_TIME, text)

    def _adopt(
        self, config: NodeConfig, measured: MeasuredReadout, along: ScanDirection
    ) -> NodeConfig:
        """The settings with a measured readout time, once it is well known.

        Args:
            along: the direction in which it would be positive.
        """
        value = abs(measured.readout_time)
        sure = measured.relative_deviation < _WELL_KNOWN and measured.triples >= _ENOUGH
        if not sure or value > LONGEST_READOUT_TIME:
            return config
        direction = along if measured.readout_time > 0.0 else REVERSED[along]
        self._notice(
            Notice.READOUT_TIME,
            f"estimated: {_milliseconds(value, measured.deviation)}, {direction}; set readout_time "
            f"to {value:.5f} and scan_direction to {direction} to have it from the start",
        )
        return replace(
            config,
            readout_time=value,
            readout_time_deviation=min(measured.deviation, LONGEST_READOUT_TIME),
            scan_direction=direction.value,
        )


def _verdict(config: NodeConfig, measured: MeasuredReadout, at_rest: bool) -> tuple[str, str]:
    """The fault of the readout time that is set, and a sentence that says it; or nothing.

    ``at_rest``: all rows are certainly exposed at once, whatever errors of the map look like.
    """
    usual, found = config.readout_time, measured.readout_time
    if not (at_rest or measured.contradicts(usual)):
        return "", ""
    instant = at_rest or abs(found) < _GLOBAL * usual
    if not instant and found < -_SURELY * measured.deviation:
        direction = ScanDirection(config.scan_direction)
        return _REVERSED, (
            f"the shutter moves against scan_direction {direction}, in "
            f"{_milliseconds(-found, measured.deviation)}: is it {REVERSED[direction]}?"
        )
    said = "0 ms" if at_rest else _milliseconds(found, measured.deviation)
    return _GLOBAL_SHUTTER if instant else _DURATION, (
        f"estimated readout time {said}{' (a global shutter)' if instant else ''} differs from "
        f"readout_time = {1e3 * usual:g} ms"
    )


def _milliseconds(value: float, deviation: float) -> str:
    return f"{1e3 * value:.1f} +- {1e3 * deviation:.1f} ms"
