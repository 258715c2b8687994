# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of the localizer: a level, one sentence, and the numbers by readable names."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from rs_localizer.core.reasons import Notice
from rs_localizer.io.messages import make_header
from rs_localizer.io.outputs import Localized
from rs_localizer.pipeline.camera_frames import DOUBTFUL
from rs_localizer.pipeline.inputs import Role, input_in_words, input_named
from rs_localizer.pipeline.map_to_odom import Decision, Standing
from rs_localizer.ros.node.conversion import make_message
from rs_localizer.ros.node.diagnostics import (
    Health,
    Level,
    State,
    counts,
    hindrance,
    one_line,
    out_of_service,
)
from rs_localizer.ros.node.statistics import Summary, Told
from rs_localizer.ros.node.subscriptions import Silence

DEVIATION = "Position deviation (cm)"
"""Name of a value: root of the sum over the axes, of the last pose."""


def tell(frame: Localized) -> tuple[int, Told]:
    """Return the stamp of the input (ns), and what the statistics keep of it."""
    estimate = frame.estimate
    residuals = estimate.residuals[estimate.inliers]
    points, inliers = len(estimate.inliers), len(residuals)
    residual = float(np.sqrt(residuals @ residuals / max(inliers, 1)))
    values = {
        "Points": str(points),
        "Inliers": str(inliers),
        "Residual RMS (px)": f"{residual:.3f}",
        "Model error (px)": f"{estimate.model_error:.3f}",
        "Iterations": str(estimate.iterations),
        DEVIATION: f"{100.0 * math.sqrt(frame.pose.covariance[:3, :3].trace()):.2f}",
    }
    for camera in frame.cameras:  # of a rig
        share = camera.inliers / max(camera.points, 1)
        values |= {
            f"Inliers of {camera.name}": f"{camera.inliers} of {camera.points} ({share:.0%})",
            f"Residual RMS of {camera.name} (px)": f"{camera.residual:.3f}",
        }
    state = State.TRACKING if estimate.tracked else State.LOCALIZED
    text = f"{state} with {inliers} of {points} points"
    if frame.twist is not None and frame.known_twist is None:
        text += ", twist unknown"
    return frame.input_stamp_ns, Told(state, text, values)


def integrity_message(frame: Localized) -> DiagnosticArray:
    """Return the probability that a pose lies outside its region, with its stamp."""
    doubt = frame.estimate.integrity
    status = DiagnosticStatus(
        level=bytes([Level.WARN if doubt > DOUBTFUL else Level.OK]),
        name="rs_localizer: integrity",
        message=f"the pose lies outside its 99.9 % region with a probability of {doubt:.2%}",
        hardware_id=frame.body_frame,
        values=[KeyValue(key="integrity", value=f"{doubt:.6f}")],
    )
    header = make_header(make_message, frame.stamp_ns, frame.map_frame)
    return DiagnosticArray(header=header, status=[status])


# Frames in a row without a pose after which the camera is lost.
_LOST = 5
# A frame that is worked on for longer (s) holds up the others.
_LONG_WORK = 1.0


@dataclass(frozen=True, slots=True)
class Condition:
    """The node's knowledge of itself."""

    life_cycle: str  # label of the state
    missing: Sequence[str]  # inputs without which no frame can be localized
    silence: Mapping[str, Silence]  # by input topic
    oddities: Mapping[str, str] = field(default_factory=dict)  # noticed lately, by name
    correction: Decision | None = None  # of odometry; None: there has been none
    values: Mapping[str, str] = field(default_factory=dict)  # others, by readable names


def of_interest(silence: Mapping[str, Silence], missing: Sequence[str]) -> dict[str, Silence]:
    """Drop the inputs that nobody publishes and nothing waits for.

    Frames come as correspondences or as keypoints; only keypoints need a map.
    """
    coming, kept = any(item.heard for item in _of_frames(silence)), {}
    for name, item in silence.items():
        row = input_named(name)
        awaited = not coming if row.role == Role.FRAMES else row.necessary or name in missing
        if item.heard or item.mismatch or awaited:
            kept[name] = item
    return kept


def _of_frames(silence: Mapping[str, Silence]) -> list[Silence]:
    return [item for name, item in silence.items() if input_named(name).role == Role.FRAMES]


def diagnose(condition: Condition, summary: Summary) -> Health:
    """Judge the node.

    The states are ``inactive``, ``waiting for`` something missing or frames, ``busy``, ``lost``,
    ``localized`` (by a search) and ``tracking``. An oddity is a warning if there is nothing worse
    to report, and another broadcaster of the same transform is an error whatever else there is.
    """
    health = _judge(condition, summary)
    rival = condition.oddities.get(Notice.SECOND_BROADCASTER, "")
    if rival not in health.message and health.state is not State.INACTIVE:
        health = replace(health, level=Level.ERROR, message=f"{health.message}; {rival}")
    return health.with_values(_values(condition, summary))


def _judge(condition: Condition, summary: Summary) -> Health:
    if (idle := out_of_service(condition.life_cycle)) is not None:
        return idle
    if summary.busy is not None and summary.busy > _LONG_WORK:
        message = f"a frame has been worked on for {summary.busy:.1f} s"
        return Health(Level.WARN, State.BUSY, message)
    silent = _silent_frames(condition)
    if condition.missing:
        level = Level.WARN if silent else Level.ERROR
        what = " and ".join(input_in_words(name) for name in condition.missing)
        causes = [f"{it.topic}: {it.cause}" for it in condition.silence.values() if it.cause]
        for reason in (input_named(name).refused for name in condition.missing):
            if count := summary.reasons.get(reason):
                causes.append(f"{count} cannot be used: see {reason} in the log")
        if any(item.mismatch for item in condition.silence.values()):
            level = Level.ERROR
        message = "; ".join([f"{State.WAITING} {what}", *causes])
        return Health(level, State.WAITING, message, subject=what)
    if silent is not None:
        return silent
    return _judge_frames(summary, condition)


def _silent_frames(condition: Condition) -> Health | None:
    """Return the health if no frames come; None if they do."""
    silences = _of_frames(condition.silence)
    if not silences or any(item.heard and not item.cause for item in silences):
        return None
    causes = [f"{item.topic}: {item.cause}" for item in silences if item.cause]
    latest = min(silences, key=lambda item: (not item.heard, item.seconds))
    if any(item.mismatch for item in silences):
        level = Level.ERROR
    else:
        level = Level.STALE if latest.heard else Level.WARN
    since = f" for {latest.seconds:.0f} s" if latest.heard else ""
    message = "; ".join([f"no frame has come{since}", *causes])
    return Health(level, State.WAITING, message, subject="frames")


def _judge_frames(summary: Summary, condition: Condition) -> Health:
    last, oddities = summary.last, condition.oddities
    if last is None or summary.refused_since_answer >= _LOST:
        if summary.refused_since_answer == 0:
            message = "no frame has been localized yet"
            return Health(Level.WARN, State.WAITING, message, subject="frames")
        message = f"the last {summary.refused_since_answer} frames gave no pose"
        if reasons := summary.recent_reasons:
            message += f", mostly for {max(reasons, key=lambda reason: reasons[reason])}"
        held = "" if condition.correction is None else str(condition.correction)
        message = "; ".join(filter(None, [message, held, one_line(oddities)]))
        return Health(Level.ERROR, State.LOST, message)
    state = State(last.state)
    correction = condition.correction
    if correction is not None and correction.standing is Standing.CONTRADICTED:
        return Health(Level.ERROR, state, f"map -> odom is contradicted: {correction}")
    if text := oddities.get(Notice.SECOND_BROADCASTER):
        return Health(Level.ERROR, state, text)
    if message := hindrance(summary, "frames") or one_line(oddities):
        return Health(Level.WARN, state, message)
    return Health(Level.OK, state, last.text)


def _values(condition: Condition, summary: Summary) -> dict[str, str]:
    values = counts(summary, "Frames", "Poses out")
    values |= condition.values
    values |= {f"Topic {item.topic}": _heard(item) for item in condition.silence.values()}
    return values | {f"Notice: {name}": text for name, text in condition.oddities.items()}


def _heard(item: Silence) -> str:
    if not item.cause:
        quality = "reliable" if item.reliable else "best effort"
        return f"messages arrive, {quality}" if item.heard else "no message yet"
    return f"silent for {item.seconds:.0f} s: {item.cause}"
