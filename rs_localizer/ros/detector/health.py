"""How the marker detector is: a level, one sentence, and the numbers by readable names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rs_localizer.ros.localizer.health import Health, Level, lost_on_the_way, told
from rs_localizer.ros.node.inputs import Silence
from rs_localizer.ros.node.statistics import WINDOW, Summary

# Share of the images that may be refused or replaced before it is worth a warning.
_SOME = 0.05


@dataclass(frozen=True, slots=True)
class Sight:
    """What is told of the last image."""

    markers: int  # of the map
    boards: int
    corners: int
    unknown: int  # markers that are not in the map


@dataclass(frozen=True, slots=True)
class Condition:
    """What the node knows of itself."""

    life_cycle: str  # label of the state
    wanted: bool  # whether somebody listens
    silence: Mapping[str, Silence]  # of the image topics
    oddities: Mapping[str, str] = field(default_factory=dict)  # noticed lately, by name


def diagnose(condition: Condition, summary: Summary) -> Health:
    """Judge the node: ``inactive``, ``idle``, ``waiting for images`` or ``detecting``."""
    level, state, message = _judge(condition, summary)
    values = {
        "State": state,
        "Images in (Hz)": f"{summary.rate_in:.1f}",
        "Images done (Hz)": f"{summary.rate_out:.1f}",
    }
    if summary.latency is not None:
        values["Latency p50 (ms)"] = f"{1e3 * summary.latency[0]:.2f}"
        values["Latency p95 (ms)"] = f"{1e3 * summary.latency[1]:.2f}"
    if summary.last is not None:
        values |= {
            "Markers": str(summary.last.markers),
            "Boards": str(summary.last.boards),
            "Corners": str(summary.last.corners),
            "Markers not in the map": str(summary.last.unknown),
        }
    values |= {
        "Images received": str(sum(summary.received.values())),
        "Images done": str(summary.answered),
        "Images replaced": str(summary.replaced),
        "Images refused": str(summary.refused),
    }
    values |= {f"Refused: {reason}": str(n) for reason, n in sorted(summary.refusals.items())}
    return Health(level, state, message, values)


def _judge(condition: Condition, summary: Summary) -> tuple[Level, str, str]:
    if condition.life_cycle == "configuring":
        return Level.WARN, "compiling", "the node is being configured: kernels are compiled"
    if condition.life_cycle != "active":
        return Level.OK, "inactive", f"the node is {condition.life_cycle}: activate it"
    if not condition.wanted:
        return Level.OK, "idle", "nobody listens to the correspondences or the debug image"
    causes = [f"{item.topic}: {item.cause}" for item in condition.silence.values() if item.cause]
    if causes or not condition.silence:
        message = "; ".join(["waiting for images", *causes])
        return Level.WARN, "waiting for images", message
    refused = sum(summary.recently_refused.values())
    if refused > _SOME * summary.recently_received:
        reasons = ", ".join(sorted(summary.recently_refused))
        message = f"{refused} images were refused in the last {WINDOW:.0f} s: {reasons}"
        return Level.WARN, "detecting", message
    if summary.recently_replaced > _SOME * summary.recently_received:
        message = (
            f"{summary.recently_replaced} images came while another was looked at in the last "
            f"{WINDOW:.0f} s"
        )
        return Level.WARN, "detecting", message
    if summary.recently_missing > _SOME * summary.recently_received:
        return Level.WARN, "detecting", lost_on_the_way(summary)
    if condition.oddities:
        return Level.WARN, "detecting", told(condition.oddities)
    last = summary.last
    if last is None:
        return Level.OK, "detecting", "no image has been looked at yet"
    if last.corners == 0:
        return Level.OK, "detecting", "the last image shows nothing of the map"
    return (
        Level.OK,
        "detecting",
        f"{last.corners} corners of {last.markers} markers"
        + (f" and {last.boards} boards" if last.boards else ""),
    )
