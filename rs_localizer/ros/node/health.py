"""What every node says of itself: a level, a state, one sentence, and numbers by readable names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Any, NamedTuple

from rs_localizer.ros.node.statistics import WINDOW, Percentiles, Summary

SOME = 0.05
"""Share of the messages that may be refused, replaced or lost before it is worth a warning."""


class State(StrEnum):
    """Of nodes: THE list; docs/reasons.md says what each means and what to do."""

    COMPILING = "compiling"
    INACTIVE = "inactive"
    WAITING = "waiting for"  # what, is the subject
    # Of the localizer.
    BUSY = "busy"
    LOST = "lost"
    LOCALIZED = "localized"
    TRACKING = "tracking"
    # Of nodes that look at images.
    IDLE = "idle"
    DETECTING = "detecting"


# What a node that is not active needs, by the label of its state.
_STEPS = {"unconfigured": "configure and activate it", "finalized": "start it again"}


class Level(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class Health:
    """A diagnosis."""

    level: Level
    state: State
    message: str
    values: dict[str, str]


class Judgement(NamedTuple):
    """What to say first."""

    level: Level
    state: State
    message: str
    subject: str = ""  # of the state

    @property
    def state_in_words(self) -> str:
        """The state with its subject."""
        return f"{self.state} {self.subject}".strip()


def out_of_service(life_cycle: str) -> Judgement | None:
    """What to say of a node that is not active, by the label of its state; None if it is."""
    if life_cycle == "configuring":
        return Judgement(
            Level.WARN, State.COMPILING, "the node is being configured: kernels are compiled"
        )
    if life_cycle == "active":
        return None
    # Somebody wants it so: no fault, which an aggregator would make of STALE.
    steps = _STEPS.get(life_cycle, "activate it")
    return Judgement(Level.OK, State.INACTIVE, f"the node is {life_cycle}: {steps}")


def told(oddities: Mapping[str, str]) -> str:
    """What is odd, in one line."""
    return "; ".join(f"{name}: {text}" for name, text in oddities.items())


def lost_on_the_way(summary: Summary[Any]) -> str:
    """What to say where stamps have gaps."""
    sent = summary.recently_received + summary.recently_missing
    return (
        f"messages are lost: by their stamps, {summary.recently_missing} of {sent} have not come "
        f"in the last {WINDOW:.0f} s (is the publisher best effort, or the machine too slow?)"
    )


def milliseconds(name: str, value: Percentiles | None) -> dict[str, str]:
    """Median and 95th percentile as values of a diagnosis; nothing where they are unknown."""
    if value is None:
        return {}
    return {
        f"{name} p50 (ms)": f"{1e3 * value[0]:.2f}",
        f"{name} p95 (ms)": f"{1e3 * value[1]:.2f}",
    }


def refused(summary: Summary[Any]) -> dict[str, str]:
    """How often which reason, as values of a diagnosis."""
    return {f"Refused: {reason}": str(n) for reason, n in sorted(summary.refusals.items())}
