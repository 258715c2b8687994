"""What a localizer node says of itself, as text for a terminal; knows no ROS."""

from __future__ import annotations

import warnings
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array

# Rates are those of the last seconds; a pose that is older than this is said to be.
_WINDOW, _OLD = 5.0, 1.0
_LEVELS = ("ok", "warning", "error", "stale")
_WIDTH = 19


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """Six numbers of a message with covariance, linear ones first, and their deviations."""

    linear: Array  # (3,) m or m/s
    angular: Array  # (3,) rad, roll pitch yaw, or rad/s
    deviations: Array  # (6,)

    @property
    def spread(self) -> tuple[float, float]:
        """Root of the summed variances of the linear three, and of the angular ones in degrees."""
        linear, angular = self.deviations[:3], self.deviations[3:]
        return float(np.linalg.norm(linear)), float(np.degrees(np.linalg.norm(angular)))


@dataclass(frozen=True, slots=True)
class Status:
    """The node's entry of ``/diagnostics``."""

    level: int
    message: str
    values: dict[str, str]

    @property
    def state(self) -> str:
        return self.values.get("State", _LEVELS[min(self.level, 3)])

    @property
    def refusals(self) -> list[str]:
        """Why frames were refused, and how often."""
        start = "Refused: "
        found = {k.removeprefix(start): v for k, v in self.values.items() if k.startswith(start)}
        return [f"{reason} {count}" for reason, count in found.items()]


@dataclass(slots=True)
class Watched:
    """All that is known of a node; times are those of one steady clock, in s."""

    node: str
    pose: Values | None = None
    twist: Values | None = None
    status: Status | None = None
    waiting: str = ""  # why nothing comes; empty: somebody publishes
    _last: float = 0.0
    _arrivals: deque[float] = field(default_factory=deque)

    def arrived(self, pose: Values, now: float) -> None:
        self.pose, self._last = pose, now
        self._arrivals.append(now)

    def rate(self, now: float) -> float:
        """Poses per second."""
        while self._arrivals and self._arrivals[0] < now - _WINDOW:
            self._arrivals.popleft()
        count = len(self._arrivals)
        span = self._arrivals[-1] - self._arrivals[0] if count > 1 else 0.0
        return (count - 1) / span if span > 0.0 else 0.0

    def heading(self, now: float) -> str:
        """State and rate, or what is waited for."""
        if self.pose is None:
            return self.waiting or (self.status.state if self.status else "waiting for a pose")
        age = now - self._last
        late = f", no pose for {age:.1f} s" if age > _OLD else ""
        state = self.status.state if self.status else "localized"
        return f"{state}, {self.rate(now):.1f} Hz{late}"


def euler(quaternion: Array) -> Array:
    """Roll, pitch and yaw (3,) in rad about the fixed axes x, y, z (REP-103), of ``x y z w``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # looking straight up, roll counts as yaw
        angles: Array = Rotation.from_quat(quaternion).as_euler("xyz")
    return angles


def line(watched: Watched, now: float) -> str:
    """All in one line, for a log."""
    words = [watched.heading(now)]
    if (pose := watched.pose) is not None:
        words += [
            f"xyz {_three(pose.linear, 3)} m +-{1e3 * pose.spread[0]:.1f} mm",
            f"rpy {_three(np.degrees(pose.angular), 2)} +-{pose.spread[1]:.2f} deg",
        ]
    if (twist := watched.twist) is not None:
        words += [
            f"v {_three(twist.linear, 2)} +-{twist.spread[0]:.2f} m/s",
            f"w {_three(np.degrees(twist.angular), 1)} +-{twist.spread[1]:.1f} deg/s",
        ]
    if (status := watched.status) is not None:
        words += [f"{_LEVELS[min(status.level, 3)]}: {status.message}", *status.refusals]
    return " | ".join(words)


def table(watched: Watched, now: float) -> list[str]:
    """A line for each quantity, for a terminal."""
    lines = [f"{watched.node}: {watched.heading(now)}"]
    if (pose := watched.pose) is not None:
        degrees = np.degrees(pose.angular)
        lines += [
            _row("position (m)", _three(pose.linear, 3), f"{pose.spread[0]:.4f}"),
            _row("roll pitch yaw (deg)", _three(degrees, 2), f"{pose.spread[1]:.3f}"),
        ]
    if (twist := watched.twist) is not None:
        degrees = np.degrees(twist.angular)
        lines += [
            _row("linear (m/s)", _three(twist.linear, 3), f"{twist.spread[0]:.3f}"),
            _row("angular (deg/s)", _three(degrees, 2), f"{twist.spread[1]:.2f}"),
        ]
    if (status := watched.status) is not None:
        lines.append(f"{_LEVELS[min(status.level, 3)]}: {status.message}")
        if status.refusals:
            lines.append(f"refused: {', '.join(status.refusals)}")
    return lines


def _row(name: str, values: str, deviation: str) -> str:
    return f"{name:{_WIDTH + 2}} {values}  +- {deviation}"


def _three(values: Array, digits: int) -> str:
    return " ".join(f"{value:+{digits + 6}.{digits}f}" for value in values)
