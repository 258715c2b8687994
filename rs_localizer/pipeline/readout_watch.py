"""The readout time that the camera's own motion shows, beside the one that is set."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from rs_localizer.config import LONGEST_READOUT_TIME, NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.clouds import Correspondences
from rs_localizer.pipeline.refusal import Notify
from rs_localizer.pipeline.scan_axis import ScanAxis
from rs_localizer.solvers.table import find_solver
from rs_localizer.trajectory.online_readout import REVERSED, ReadoutMonitor, warm_up
from rs_localizer.trajectory.readout_equations import MeasuredReadout, Measurement

# Frames from one measurement to the next: few at first, more when there is more to compute.
_AT_FIRST, _LATER = 5, 30
_GROWTH = 0.1
# Triples at which a measurement may look while one frame is localized, if that is not less than a
# round of it: a third of a millisecond.
_SHARE = 300
# A value is adopted when it is known to this share of itself, by so many frames.
_WELL_KNOWN, _ENOUGH = 0.02, 60
# So many deviations below zero, rows run the other way.
_SURELY = 4.0
# Of the setting: from here on frames that stand alone are better than tracked ones, and from here
# on nothing tells the shutter from a global one.
_FAR_OFF, _GLOBAL = 0.5, 0.2
_CERTAINLY = math.log(1e9)  # of the odds for a global one that was found


class _Kind(Enum):
    """What is wrong about a readout time."""

    DURATION = auto()
    REVERSED = auto()
    GLOBAL = auto()
    AXIS = auto()


class ReadoutWatch:
    """Measures the readout time while frames are localized, and says when it contradicts.

    Args:
        notice: told of a contradiction, once of each kind until :meth:`reset`, and of a value that
            is adopted; by the name ``readout_time`` and one sentence.
    """

    def __init__(self, notice: Notify) -> None:
        self._notice = notice
        self._monitor = ReadoutMonitor()
        self._axis = ScanAxis()
        self._under_way: Measurement | None = None
        self._frames, self._next = 0, _AT_FIRST
        self._said: set[_Kind] = set()
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
        # Whether rows are measured to run the other way.
        self._reversed = False
        # Whether the last frames move, but not as the setting says, and no measurement tells.
        self.doubtful = False

    @property
    def trusted(self) -> bool:
        """Whether what the camera does from frame to frame tells what it does within them."""
        return not (self.far_off or self.doubtful)

    @property
    def axis_in_doubt(self) -> bool:
        """Whether frames fit better with the other axis: then nothing else that they say holds."""
        return self._axis.doubtful

    @property
    def wrong_axis(self) -> str:
        """Why no pose may be published: the shutter moves along the other axis; empty: it may."""
        if self._axis.undecided:
            return "the image fits a shutter along the other axis better than scan_direction"
        return self.fault if self._axis.wrong else ""

    @property
    def may_be_reversed(self) -> bool:
        """Whether rows may run the other way: then an image begins where it is said to end."""
        return self._reversed or (self.doubtful and self._monitor.odds.may_be_reversed)

    @property
    def of_rest(self) -> float:
        """Logarithm of the odds that what looks like motion within an image is none."""
        return _CERTAINLY if self.global_shutter else 0.0

    def warm_up(self, camera: Camera) -> None:
        """Compile what frames of this camera need."""
        warm_up(camera)

    def reset(self) -> None:
        """Forget all frames."""
        self._monitor.reset()
        self._axis.reset()
        self._under_way = None
        self._frames, self._next = 0, _AT_FIRST
        self._said.clear()
        self.measured, self.fault, self.error = None, "", 0.0
        self.far_off = self.global_shutter = self.surely_global = False
        self.doubtful = self._reversed = False

    def add(
        self,
        config: NodeConfig,
        camera: Camera,
        time_ns: int,
        result: Estimate | Failure,
        cloud: Correspondences,
    ) -> NodeConfig:
        """Take a frame whose middle row was exposed at ``time_ns``, and what came of it.

        Returns:
            the settings, with the readout time and scan direction that were measured where they
            ask for it.
        """
        estimates = config.estimate_readout_time and config.readout_time == 0.0
        wanted = estimates or config.readout_time > 0.0
        if not (wanted and find_solver(config.solver).rolling_shutter):
            return config
        self._axis.add(config, camera, time_ns, cloud, result)
        if self._axis.wrong:
            return self._other_axis(config, estimates)
        if not result:
            return config
        lens = result.lens
        camera = camera if lens is None else lens.mended(camera)
        try:
            found = self._measure(camera, time_ns, result, cloud)
        except np.linalg.LinAlgError:  # a frame that says nothing must not stop the next ones
            self._monitor.reset()
            self._under_way, self.doubtful = None, False
            return config
        if self._axis.doubtful:
            return config
        if found is not None:
            self.measured = found
            if estimates:
                return self._adopt(config, found, ScanDirection(config.scan_direction))
            self._judge(config, found, _wrong(config, found))
        self._doubt(config)
        if _is_some(config, self.measured):
            self._axis.confirm()
        elif self.far_off or self.doubtful:
            self._axis.suspect()
        return config

    def _other_axis(self, config: NodeConfig, estimates: bool) -> NodeConfig:
        """Say that the shutter moves along the other axis, or adopt it."""
        found, direction = self._axis.measured, self._axis.direction
        assert found is not None
        assert direction is not None
        value = _milliseconds(abs(found.readout_time), found.deviation)
        self._contradict(
            _Kind.AXIS,
            f"the image shows a shutter that moves {direction} in {value}, not "
            f"{config.scan_direction}; no poses are published until scan_direction is {direction}",
        )
        return self._adopt(config, found, direction) if estimates else config

    def _doubt(self, config: NodeConfig) -> None:
        """What a few frames tell, as long as a measurement says nothing else."""
        odds = self._monitor.odds
        silent = self.fault == "" and not _is_some(config, self.measured)
        self.doubtful = silent and odds.doubtful
        if silent and odds.certain:
            self.far_off = self.global_shutter = self.surely_global = True
            self.doubtful = False
            self._contradict(_Kind.GLOBAL, _sentence(_Kind.GLOBAL, config, None))

    def _judge(self, config: NodeConfig, found: MeasuredReadout, wrong: _Kind | None) -> None:
        sure = self._monitor.odds.certain  # of a global one, whatever errors of the map look like
        if wrong is None:
            self.fault = ""
        elif sure:
            self._contradict(_Kind.GLOBAL, _sentence(_Kind.GLOBAL, config, None))
        else:
            self._contradict(wrong, _sentence(wrong, config, found))
        off = math.hypot(found.readout_time - config.readout_time, found.deviation)
        shorter = config.readout_time / max(
            abs(found.readout_time), _GLOBAL * config.readout_time, found.deviation
        )
        self.error = 0.0 if wrong is None else off * max(shorter, 1.0)
        may_be = _may_be_none(config, found)
        self.far_off = may_be and (self.far_off or wrong is not None)
        self.global_shutter = self.far_off and (
            self.global_shutter if wrong is None else sure or wrong is _Kind.GLOBAL
        )
        self.surely_global = self.global_shutter and (self.surely_global or sure)
        self._reversed = wrong is _Kind.REVERSED and not sure

    def _contradict(self, kind: _Kind, text: str) -> None:
        self.fault = text
        if kind not in self._said:
            self._said.add(kind)
            self._notice(Notice.READOUT_TIME, text)

    def _measure(
        self, camera: Camera, time_ns: int, estimate: Estimate, cloud: Correspondences
    ) -> MeasuredReadout | None:
        self._monitor.add(time_ns, camera, estimate, cloud.points, cloud.pixels)
        self._frames += 1
        if self._frames >= self._next:
            self._next += min(max(_AT_FIRST, round(_GROWTH * self._frames)), _LATER)
            self._under_way = self._monitor.measurement()
        if self._under_way is None:
            return None
        self._under_way.advance(_SHARE)
        if not self._under_way.done:
            return None
        found, self._under_way = self._under_way.found, None
        return found

    def _adopt(
        self, config: NodeConfig, found: MeasuredReadout, along: ScanDirection
    ) -> NodeConfig:
        """The settings with a measured readout time, once it is well known.

        Args:
            along: the direction in which it would be positive.
        """
        value = abs(found.readout_time)
        known = found.relative_deviation < _WELL_KNOWN and found.triples >= _ENOUGH
        if not known or value > LONGEST_READOUT_TIME:
            return config
        direction = along if found.readout_time > 0.0 else REVERSED[along]
        self._notice(
            Notice.READOUT_TIME,
            f"estimated: {_milliseconds(value, found.deviation)}, {direction}; set readout_time to "
            f"{value:.5f} and scan_direction to {direction} to have it from the start",
        )
        return replace(
            config,
            readout_time=value,
            readout_time_deviation=min(found.deviation, LONGEST_READOUT_TIME),
            scan_direction=direction.value,
        )


def _may_be_none(config: NodeConfig, found: MeasuredReadout) -> bool:
    """Whether the readout time may be so far off that a global shutter is no worse."""
    return found.readout_time < _FAR_OFF * config.readout_time


def _is_some(config: NodeConfig, found: MeasuredReadout | None) -> bool:
    """Whether the readout time was measured, and nearer to the one that is set than to none."""
    if found is None:
        return False
    return found.readout_time - _SURELY * found.deviation > _FAR_OFF * config.readout_time


def _wrong(config: NodeConfig, found: MeasuredReadout) -> _Kind | None:
    if not found.contradicts(config.readout_time):
        return None
    if abs(found.readout_time) < _GLOBAL * config.readout_time:
        return _Kind.GLOBAL
    reversed_ = found.readout_time < -_SURELY * found.deviation
    return _Kind.REVERSED if reversed_ else _Kind.DURATION


def _sentence(kind: _Kind, config: NodeConfig, found: MeasuredReadout | None) -> str:
    if kind is _Kind.REVERSED and found is not None:
        given = ScanDirection(config.scan_direction)
        return (
            f"the shutter moves against scan_direction {given}, in "
            f"{_milliseconds(-found.readout_time, found.deviation)}: is it {REVERSED[given]}?"
        )
    estimated = (
        "estimated readout time 0 ms (a global shutter)"
        if found is None
        else f"estimated readout time {_milliseconds(found.readout_time, found.deviation)}"
        + (" (a global shutter)" if kind is _Kind.GLOBAL else "")
    )
    return f"{estimated} differs from readout_time = {1e3 * config.readout_time:g} ms"


def _milliseconds(value: float, deviation: float) -> str:
    return f"{1e3 * value:.1f} +- {1e3 * deviation:.1f} ms"
