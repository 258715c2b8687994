# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of odometry, ``map -> odom`` (REP-105): which pose to believe, and how sure it is.

:func:`decide` takes one observation after the other and knows no clock and no ROS. What is held is
a pose that odometry carries on. A pose of a frame agrees with it if it is probably right and passes
a chi-squared gate. One that does not is kept aside as a second hypothesis, and believed when

* poses agree with it for a second, and odometry between them, and
* a body can have come there (a robot that is carried, wheels that slip, odometry that starts over),
  or the first hypothesis never had a second of poses itself.

A wrong map agrees with itself as well as a right one. But its poses jump from one image to the
next, from rest to rest, which no body does, and are not believed however long they last. A click is
a measurement. A refusal changes nothing of what is held; no acceptance makes drift larger than any
odometry's, or opens the gate to less certain poses.
"""

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.integrity import MOST_JUMP
from rs_localizer.io.transforms import Transform
from rs_localizer.pipeline.carried_pose import (
    PERSISTS,
    PLACE,
    TURN,
    CarriedPose,
    Click,
    Drift,
    FoundPose,
    Hypothesis,
    Odometry,
    carried_pose,
    far,
    least_jump,
)

# Chi-squared, 99.99 %: of x, y and heading, and of six numbers. By chance a camera of 30 Hz has ten
# poses an hour refused, one at a time, while odometry carries on what is held.
_GATES = {3: 21.1, 6: 27.9}
_CLEARLY = 9.0  # twice the logarithm of ninety to one, against the hypothesis that has more poses
# A person who carries a robot walks (m/s) and turns (rad/s) at most this fast. Faster motion has to
# be noise, of at most two deviations.
_PACE, _SPIN, _SLACK = 1.5, 3.0, 4.0
# s of agreement that a hypothesis needs to be believed; s for which poses of which nothing followed
# are remembered.
_AGREES, _BRIEF = 1.0, 1.0
_FRESH = 0.5  # s after a pose until which it is tracking; cameras of 5 Hz may miss one image
_RESTART = 500_000_000  # ns by which time goes back only if a recording starts over


class Standing(StrEnum):
    """How ``map -> odom`` is known."""

    LOST = "lost"
    HELD = "held"
    TRACKING = "tracking"
    CONTRADICTED = "contradicted"


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionState:
    """State between observations; :func:`decide` returns the next one."""

    held: Hypothesis | None = None
    aside: Hypothesis | None = None
    refused: Hypothesis | None = None  # the last click that was
    base: CarriedPose | None = None  # that drift is judged by
    drift: Drift = field(default_factory=Drift)
    newest: Odometry | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Consequences of an observation."""

    state: CorrectionState
    standing: Standing
    map_from_odom: Transform | None = None  # to be sent; None: nothing
    covariance: Array | None = None  # (6,6) of the body's pose by it
    of_transform: Array | None = None  # (6,6) of map_from_odom: of the odometry's origin
    seconds: float = 0.0  # since the last pose or click that was believed
    jump: Array | None = None  # (6,) from what is held to what contradicts it
    smallest: tuple[float, float] | None = None  # jump that would be refused
    said: str = ""  # a hypothesis is believed now; the answer to a click

    def __str__(self) -> str:
        if self.covariance is None:
            return str(self.standing)
        own = far(np.sqrt(self.covariance.diagonal()))
        if self.map_from_odom is None:
            return f"not sent since hold ended, {self.seconds:.1f} s after the last frame, {own}"
        text = f"holding for {self.seconds:.1f} s, {own}"
        if self.jump is None:
            return text
        return f"{text}; contradicted by poses {far(self.jump)} from there"


def decide(config: NodeConfig, state: CorrectionState, seen: Odometry | FoundPose) -> Decision:
    """Decide after an observation; pure: equal arguments give equal decisions."""
    now = seen if isinstance(seen, Odometry) else seen.at
    last = state.held.newest.since if state.held and isinstance(seen, FoundPose) else state.newest
    if last and now.stamp_ns < last.stamp_ns - _RESTART and not isinstance(seen, Click):
        state = CorrectionState(drift=state.drift)
    now, newest = now.after(state.newest)
    state = replace(state, newest=newest)
    said, case = "", _Case(config, state, now)
    if isinstance(seen, FoundPose):
        pose = carried_pose(now, seen.map_from_body, seen.covariance, case.axes)
        if isinstance(seen, Click):
            state, said = case.clicked(Hypothesis(pose, pose, now.stamp_ns))
        else:
            found = Hypothesis(pose, pose, now.stamp_ns, now.stamp_ns)
            state, said = case.posed(found, seen.doubt)
    return _Case(config, state, now).decision(said)


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """The rules, for one moment."""

    config: NodeConfig
    state: CorrectionState
    now: Odometry

    @property
    def axes(self) -> list[int]:
        """Return which of the six numbers of a pose the transform has."""
        return [0, 1, 5] if self.config.two_d_mode else [0, 1, 2, 3, 4, 5]

    @property
    def gate(self) -> float:
        return _GATES[len(self.axes)]

    def posed(self, found: Hypothesis, doubt: float) -> tuple[CorrectionState, str]:
        """Return the state after a pose, probably right or not, and the sentence to say."""
        state, held, aside = self.state, self.held, self.aside
        # Whether the track has jumped, odometry tells: a jump alone is no ground for doubt.
        right = not doubt > MOST_JUMP
        if held is not None and self.now.stamp_ns <= held.newest.since.stamp_ns:
            return state, ""
        if held is None:
            return replace(state, held=found, aside=None, base=found.pose) if right else state, ""
        ours, theirs = self._misfit(held, found), self._misfit(aside, found)
        # A hypothesis that has grown for long explains much, but a sharper one explains it better.
        likelier = ours[1] <= theirs[1] + (-_CLEARLY if aside and aside.told else _CLEARLY)
        if self._passes(ours) and (likelier or not self._passes(theirs)):
            if not right:
                return replace(state, held=replace(held, near_ns=self.now.stamp_ns)), ""
            base, drift = state.drift.judged(state.base or found.pose, found.pose, self.now)
            held = replace(held.renewed(found, *self._drift, _AGREES), earlier=held.newest)
            if aside and (not aside.told or aside.newest.seconds(self.now) > _BRIEF):
                aside = None
            return replace(state, held=held, aside=aside, base=base, drift=drift), ""
        if aside is None or not self._passes(theirs):
            if aside and self._stays(aside, found):
                return state, ""
            reachable = self._reachable(held, aside, found)
            left_ns = aside.left_ns if aside and aside.told else held.near_ns
            found = replace(found, reachable=reachable, left_ns=left_ns, earlier=found.pose)
            return replace(state, aside=found), ""
        most = _AGREES if right else max(aside.support, PERSISTS)
        found = aside.renewed(found, *self._drift, most)
        if found.told and not aside.told:  # later, odometry has drifted too far to tell
            found = replace(found, reachable=found.reachable and not found.stepped(held))
        if found.support < _AGREES or not (found.reachable or held.support < _AGREES):
            return replace(state, aside=found), ""
        jump = far(held.pose.offset(found.pose, self.now))
        said = f"map -> odom moves the body by {jump}: poses agreed on that for {_AGREES:g} s"
        return replace(state, held=found, aside=None, base=found.pose), said

    def clicked(self, found: Hypothesis) -> tuple[CorrectionState, str]:
        """Return the state after a user's pose, and the answer."""
        state, held = self.state, self.held
        for known, text in ((held, "as a measurement"), (self.aside, "for what contradicts it")):
            if known and known.seen_ns > 0 and self._passes(self._misfit(known, found)):
                pose = known.pose.fused(found.pose, self.now, *self._drift)
                fused = replace(known, pose=pose, newest=pose, reachable=True)
                aside, base = (self.aside, state.base) if known is held else (None, None)
                state = replace(state, held=fused, aside=aside, base=base, refused=None)
                return state, f"taken {text}"
        again = self._passes(self._misfit(state.refused, found))
        if held is None or held.seen_ns < 0 or again:  # who clicks again means that one
            text = "taken: it came twice" if again else "taken: map -> odom begins with it"
            return replace(state, held=found, aside=None, base=None, refused=None), text
        jump, spread = held.pose.offset(found.pose, self.now), self._grown(held.newest)
        return replace(state, refused=found), (
            f"refused: it lies {far(jump)} from where map -> odom has the body, known to "
            f"{far(np.sqrt(spread.diagonal()))}; the same again is taken"
        )

    def decision(self, said: str) -> Decision:
        """Return the transform to send now."""
        state, held, aside = self.state, self.state.held, self.aside
        if held is None:
            return Decision(state, Standing.LOST, said=said)
        seconds, grown = held.newest.seconds(self.now), self._grown(held.newest)
        if self.held is None:
            return Decision(state, Standing.LOST, None, grown, seconds=seconds, said=said)
        fresh = 1e-9 * (self.now.stamp_ns - held.seen_ns) < _FRESH
        standing, jump = Standing.TRACKING if fresh else Standing.HELD, None
        spread = self._grown(held.pose) + held.pose.covariance
        smallest = least_jump(spread, self.axes, self.gate)
        if aside is not None:  # room for what may be as well
            off = held.pose.offset(aside.pose, self.now)
            grown = grown + np.outer(off, off)
            if aside.told:
                standing, jump = Standing.CONTRADICTED, off
        of_transform = held.pose.of_transform(grown, self.now)
        return Decision(state, standing, held.pose.map_from_odom, grown, of_transform, seconds,
                        jump, smallest, said)  # fmt: skip

    @property
    def held(self) -> Hypothesis | None:
        """Hypothesis that is held and not given up."""
        held, hold = self.state.held, self.config.hold
        ended = held is not None and 0.0 < hold < held.newest.seconds(self.now)
        return None if ended else held

    @property
    def aside(self) -> Hypothesis | None:
        """Hypothesis that contradicts the held one; None for a few poses without consequence."""
        aside = self.state.aside
        brief = aside is None or aside.told or aside.newest.seconds(self.now) < _BRIEF
        return aside if brief else None

    @property
    def _drift(self) -> tuple[Drift, list[int]]:
        return self.state.drift, self.axes

    def _grown(self, pose: CarriedPose) -> Array:
        return pose.grown(self.now, *self._drift)

    def _misfit(self, known: Hypothesis | None, found: Hypothesis) -> tuple[float, float]:
        """Return the squared distance in deviations, and -2 log likelihood less 2 pi."""
        if known is None:
            return math.inf, math.inf
        spread, offset = self._spread(known, found), known.pose.offset(found.pose, self.now)
        distance = self._distance(offset, spread)
        return distance, distance + float(np.linalg.slogdet(spread)[1])

    def _spread(self, known: Hypothesis, found: Hypothesis) -> Array:
        spread = self._grown(known.pose) + found.pose.covariance
        return spread[np.ix_(self.axes, self.axes)]

    def _distance(self, offset: Array, spread: Array) -> float:
        own = offset[self.axes]
        return float(own @ np.linalg.solve(spread, own))

    def _passes(self, misfit: tuple[float, float]) -> bool:
        return misfit[0] <= self.gate

    def _stays(self, aside: Hypothesis, found: Hypothesis) -> bool:
        """Return whether a hypothesis outlasts a pose elsewhere."""
        since = aside.newest.seconds(self.now)
        if aside.told:  # one pose ends no contradiction
            return since <= _BRIEF
        sharper = aside.pose.sharper(found.pose, self.now, *self._drift)
        return since <= PERSISTS and sharper is aside.pose

    def _reachable(self, held: Hypothesis, aside: Hypothesis | None, found: Hypothesis) -> bool:
        """Return whether a body can have got from the last pose to a new one, despite odometry."""
        if aside and aside.told and not (aside.reachable and self._near(aside, found, self.gate)):
            return False
        return self._near(held, found, _SLACK)

    def _near(self, known: Hypothesis, found: Hypothesis, slack: float) -> bool:
        """Return whether a pose is within reach of the known or carried one, but for noise."""
        reach = np.multiply((_PACE, _SPIN), 1e-9 * (self.now.stamp_ns - known.near_ns))
        for start in (known.pose, known.pose.staying(known.newest.since, self.now)):
            off = start.offset(found.pose, self.now)
            for part, most in zip((PLACE, TURN), reach, strict=True):
                off[part] *= max(1.0 - most / max(float(np.linalg.norm(off[part])), 1e-12), 0.0)
            if self._distance(off, self._spread(known, found)) <= slack:
                return True
        return False
