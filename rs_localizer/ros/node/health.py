"""What every node says of itself: a level, a state, one sentence, and numbers by readable names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from rs_localizer.ros.node.statistics import WINDOW, Percentiles, Summary

SOME = 0.05
"""Share of the messages that may be refused, replaced or lost before it is worth a warning."""

COMPILING = "compiling"
INACTIVE = "inactive"
WAITING = "waiting for"
LOST = "lost"

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
    state: str
    message: str
    values: dict[str, str]


Judgement = tuple[Level, str, str]
"""Level, state, message."""


def out_of_service(life_cycle: str) -> Judgement | None:
    """What to say of a node that is not active, by the label of its state; None if it is."""
    if life_cycle == "configuring":
        return Level.WARN, COMPILING, "the node is being configured: kernels are compiled"
    if life_cycle == "active":
        return None
    # Somebody wants it so: no fault, which an aggregator would make of STALE.
    steps = _STEPS.get(life_cycle, "activate it")
    return Level.OK, INACTIVE, f"the node is {life_cycle}: {steps}"


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
