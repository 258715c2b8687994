"""A true motion and a vibration on top of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.simulation.true_motion import TrueMotion, TrueState


@dataclass(frozen=True, slots=True, eq=False)
class Shaken:
    """A camera that swings to and fro about an axis of its own, while it moves.

    With the angle ``a(t) = A sin(2 pi f t + p)`` about the unit vector ``n`` its rotation is
    ``R exp(a n)``; its body rate ``exp(-a n) w + a' n``, its velocity in its own axes
    ``exp(-a n) v``. Several vibrations are one around the other.
    """

    motion: TrueMotion
    amplitude: float  # rad
    frequency: float  # Hz
    axis: Array  # (3,) unit vector, camera axes
    phase: float = 0.0  # rad, at the motion's start

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return self.motion.intervals_ns

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        base = self.motion.state(stamp_ns, offsets)
        # The whole seconds apart, or the phase would drown in the size of today's stamps.
        since_ns = stamp_ns - self.intervals_ns[0][0]
        t = since_ns * 1e-9 + np.asarray(offsets, float)
        pulse = 2.0 * math.pi * self.frequency
        angle = self.amplitude * np.sin(pulse * t + self.phase)
        rate = self.amplitude * pulse * np.cos(pulse * t + self.phase)
        turn = so3.exp_many(angle[:, None] * self.axis)
        return TrueState(
            base.rotations @ turn,
            base.positions,
            np.einsum("nji,nj->ni", turn, base.angular) + rate[:, None] * self.axis,
            np.einsum("nji,nj->ni", turn, base.linear),
        )


def shaken(
    motion: TrueMotion, vibrations: list[tuple[float, float]], rng: np.random.Generator
) -> TrueMotion:
    """A motion with vibrations (degrees, Hz), each about any axis and from any phase."""
    for degrees, hertz in vibrations:
        axis = rng.normal(size=3)
        phase = float(rng.uniform(0.0, 2.0 * math.pi))
        unit = axis / np.linalg.norm(axis)
        motion = Shaken(motion, math.radians(degrees), hertz, unit, phase)
    return motion
