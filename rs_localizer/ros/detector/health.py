"""How a node that looks at images is: a level, one sentence, and numbers by readable names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from rs_localizer.ros.node.health import (
    SOME,
    Health,
    Judgement,
    Level,
    State,
    lost_on_the_way,
    milliseconds,
    out_of_service,
    refused,
    told,
)
from rs_localizer.ros.node.inputs import Silence
from rs_localizer.ros.node.statistics import WINDOW, Summary


class Sight(Protocol):
    """What is told of the last image."""

    @property
    def text(self) -> str:
        """In one sentence."""
        ...

    @property
    def values(self) -> dict[str, str]:
        """By readable names."""
        ...


@dataclass(frozen=True, slots=True)
class Condition:
    """What the node knows of itself."""

    life_cycle: str  # label of the state
    output: str  # what it publishes
    wanted: bool  # whether somebody listens
    silence: Mapping[str, Silence]  # of the image topics
    oddities: Mapping[str, str] = field(default_factory=dict)  # noticed lately, by name


def diagnose(condition: Condition, summary: Summary[Sight]) -> Health:
    """Judge the node: ``inactive``, ``idle``, ``waiting for images`` or ``detecting``."""
    judgement = _judge(condition, summary)
    values = {
        "State": judgement.state_in_words,
        "Images in (Hz)": f"{summary.rate_in:.1f}",
        "Images done (Hz)": f"{summary.rate_out:.1f}",
        **milliseconds("Latency", summary.latency),
    }
    if summary.last is not None:
        values |= summary.last.values
    values |= {
        "Images received": str(sum(summary.received.values())),
        "Images done": str(summary.answered),
        "Images replaced": str(summary.replaced),
        "Images refused": str(summary.refused),
    }
    values |= refused(summary)
    return Health(judgement.level, judgement.state, judgement.message, values)


def _judge(condition: Condition, summary: Summary[Sight]) -> Judgement:
    if (idle := out_of_service(condition.life_cycle)) is not None:
        return idle
    if not condition.wanted:
        message = f"nobody listens to the {condition.output} or the debug image"
        return Judgement(Level.OK, State.IDLE, message)
    causes = [f"{item.topic}: {item.cause}" for item in condition.silence.values() if item.cause]
    if causes or not condition.silence:
        message = "; ".join([f"{State.WAITING} images", *causes])
        return Judgement(Level.WARN, State.WAITING, message, "images")
    bad = sum(summary.recently_refused.values())
    if bad > SOME * summary.recently_received:
        reasons = ", ".join(sorted(summary.recently_refused))
        message = f"{bad} images were refused in the last {WINDOW:.0f} s: {reasons}"
        return Judgement(Level.WARN, State.DETECTING, message)
    if summary.recently_replaced > SOME * summary.recently_received:
        message = (
            f"{summary.recently_replaced} images came while another was looked at in the last "
            f"{WINDOW:.0f} s"
        )
        return Judgement(Level.WARN, State.DETECTING, message)
    if summary.recently_missing > SOME * summary.recently_received:
        return Judgement(Level.WARN, State.DETECTING, lost_on_the_way(summary))
    if condition.oddities:
        return Judgement(Level.WARN, State.DETECTING, told(condition.oddities))
    last = summary.last
    message = "no image has been looked at yet" if last is None else last.text
    return Judgement(Level.OK, State.DETECTING, message)
