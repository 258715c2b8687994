# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer demo``: bundled recordings localized, a table and a picture; and a live node."""

from __future__ import annotations

import contextlib
import importlib
import io
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer import data
from rs_localizer.cli import detect_command, simulate_command, stage, typed
from rs_localizer.cli.options import option
from rs_localizer.config import NodeConfig
from rs_localizer.io import recording
from rs_localizer.io.atomic_files import atomic_files
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.io.trajectories import Motions, read_motions
from rs_localizer.offline.results import Track
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.settings import build, load_params_file
from rs_localizer.tools import errors
from rs_localizer.tools.simulation.simulated_frames import FrameSettings

# Parts of the bundled hand's motion: start and duration, s. The flight begins slowly and ends in
# quick turns; before the walls the hand turns about all axes, by up to 200 deg/s.
_FLIGHT, _WALLS = (8.0, 18.0), (21.366, 3.533)
_EXPOSURE = 0.001  # s, of a row in a bright room: at 200 deg/s it blurs by 2 px
_QUICK_FRAMES = 12
_METHODS = (NodeConfig().solver, "p3p")
Settings = Mapping[str, Any]
Frame = tuple[int, Any, Any]
"""Stamp (ns), CameraInfo and cloud."""


@dataclass(frozen=True, kw_only=True)
class Options:
    out: Path = option("for the picture", "DIR", Path("out"))
    quick: bool = option("a few frames of each recording only", default=False)
    all: bool = option(
        "also walls of markers, rendered and detected, and a live node", default=False
    )


def run(options: Options) -> None:
    started, picture = time.monotonic(), options.out / "flight_errors.png"
    options.out.mkdir(parents=True, exist_ok=True)
    most = _QUICK_FRAMES if options.quick else None
    print(f"{'medians':56}{_METHODS[0]:>9}{_METHODS[1]:>9}", flush=True)
    flight, settings, true = _simulated(most)
    answers, found = _localized("Simulated flight", flight, settings, true)
    with atomic_files(picture) as (part,):
        errors.draw(found, part)
    webcam = data.path(data.WEBCAM)
    _localized("Webcam over a board", *_recorded(webcam, webcam, most), None)
    if options.all:
        _localized("Walls of markers", *_simulated(most, images=True))
        _live(flight, answers[_METHODS[0]], {**settings, "solver": _METHODS[0]})
    print(f"{picture}\ndone in {time.monotonic() - started:.0f} s")
    print(f"next: {typed('markers', 'make', 'board', '--help')}")


def _recorded(path: Path, place: Path, most: int | None) -> tuple[list[Frame], Settings]:
    """Return the first frames of a recording, and the settings that stand in a place."""
    frames, info = list[Frame](), None
    infos, clouds = recording.CAMERA_INFO_TOPIC, recording.CORRESPONDENCES_TOPIC
    with open_bag(path) as bag:
        for topic, _, message in bag.messages({infos, clouds}):
            if topic == infos:
                info = message
            else:
                frames.append((stamp_ns(message), info, message))
    settings = load_params_file(place / recording.PARAMETERS)
    return frames[:most], {**settings, "pose_time": "mid_frame"}


def _simulated(most: int | None, images: bool = False) -> tuple[list[Frame], Settings, Motions]:
    """Return frames of a flight, or of rendered walls, their settings, and the truth."""
    start, duration = _WALLS if images else _FLIGHT
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(io.StringIO()):
        made = matches = Path(place) / "simulated"
        simulate_command.run(simulate_command.Options(
            out=made, trajectory=Path(simulate_command.BUNDLED), images=images, start=start,
            duration=duration if most is None else most / FrameSettings().rate,
            exposure=_EXPOSURE if images else 0.0,
        ))  # fmt: skip
        if images:
            matches, markers = Path(place) / "matches", made / recording.MARKER_MAP
            detect_command.detect(detect_command.Options(recording=made, map=markers, out=matches))
        return *_recorded(matches, made, None), read_motions(made)


def _localized(
    title: str, frames: Sequence[Frame], settings: Settings, true: Motions | None
) -> tuple[dict[str, dict[int, Localized]], dict[str, dict[str, errors.Errors]]]:
    """Localize the frames by method as a node does, print medians, and return errors, too."""
    answers, rows = dict[str, dict[int, Localized]](), defaultdict[str, list[float]](list)
    off = dict[str, dict[str, errors.Errors]]()
    for solver in _METHODS:
        localizer, track = CameraFrames(build({**settings, "solver": solver})), Track()
        answers[solver] = found = dict[int, Localized]()
        with stage(f"{title}, {solver}", len(frames)) as step:
            for stamp, info, cloud in frames:
                localizer.calibrate(read_camera_info(info))
                if frame := localizer.localize(cloud):
                    found[stamp] = frame
                    track.add(frame)
                step(1)
        rows["localized (%)"].append(100.0 * len(found) / len(frames))
        rms = [frame.estimate.residual_rms for frame in found.values()]
        rows["residual (px rms)"].append(float(np.median(rms)))
        off[solver] = {} if true is None else errors.errors_of(track.motions(), true)
        for kind, each in off[solver].items():
            scale, unit = (1e3, "mm") if errors.UNITS[kind] == "m" else (1.0, errors.UNITS[kind])
            rows[f"{kind} ({unit})"].append(scale * float(np.median(each.values)))
    for name, values in rows.items():
        label = f"{title}, {len(frames)} frames: {name}"
        print(f"{label:56}" + "".join(f"{value:9.3g}" for value in values), flush=True)
    return answers, off


def _live(frames: Sequence[Frame], answers: Mapping[int, Localized], settings: Settings) -> None:
    """Localize the flight once more with a live node, and compare."""
    live = importlib.import_module("rs_localizer.ros.live")  # ROS is what nothing else needs
    late, same = list[float](), 0
    with live.LiveNode(settings) as node, stage("A live node", len(frames)) as step:
        for stamp, info, cloud in frames:
            began, answer = time.perf_counter(), answers.get(stamp)
            pose = node.localize(info, cloud)
            late.append(time.perf_counter() - began)
            there = pose and [getattr(pose.pose.position, axis) for axis in "xyz"]
            same += there == (answer and answer.pose.position.tolist())
            step(1)
    p50, p95 = np.percentile(1e3 * np.array(late), [50, 95])
    print(
        f"The live node has answered {same} of {len(frames)} frames as above to the last bit;\n"
        f"{p50:.1f} ms from message to pose, 95 % within {p95:.1f} ms"
    )
