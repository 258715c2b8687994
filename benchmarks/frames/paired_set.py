# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The paired set: frames that never change, so that two estimators differ by nothing else.

Some conditions of each bench, others that show what benches have not, and frames that an estimator
should refuse, or should not; then two recorded boards and a phone.
"""

import math
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import rs_localizer as rsl
from benchmarks.data import GLOBAL_SHUTTER_TAGS
from benchmarks.frames import gross
from benchmarks.frames.conditions import (
    HAND,
    NARROW,
    SEEN,
    SINGLE,
    SLOW_HAND,
    TRACKED,
    Calibration,
    Condition,
    Motion,
    Points,
    conditions,
    moving,
    turning,
)
from benchmarks.frames.judged import Judged, judge, of_pose
from benchmarks.independent.cameras import Camera
from benchmarks.independent.scenes import Board, Rich, Scene, SmallPlane, Wall
from benchmarks.real import gyro
from benchmarks.real.clips import Clip, clips_of, opencv_lens, shutter_of
from benchmarks.real.gyroscopes import Gyroscope
from benchmarks.real.judging import METHODS, PEER, jitter, localized
from benchmarks.real.recordings import Recording, read_bag
from rs_localizer import data
from rs_localizer.config import NodeConfig
from rs_localizer.pipeline.pose_at_time import pose_at
from rs_localizer.tools.adjust.observe import ImagePoints

# Of each bench so many conditions, drawn once: 69.
_OF_BENCH = {
    "hand": 4, "grid": 9, "few": 3, "many": 1, "planes": 6, "gyro": 2, "locks": 2, "sine": 4,
    "bands": 5, "noise": 4, "impacts": 2, "real": 2, "student": 2, "shared": 2, "body": 2,
    "camera": 5, "map": 3, "bad": 2, "alike": 2, "axis": 1, "global": 2, "boards": 4,
}  # fmt: skip
# Frames of a condition; recordings of one that is tracked, and frames of each that count: a track
# that goes astray is one event, however long it is.
_FRAMES, _RECORDINGS, _COUNTED = 12, 3, 5
_LONGEST = 40  # frames of a recording: longer ones cost as much as all others together
_FLIGHTS = ((3.0, 0.03), (8.0, 0.02), (20.0, 0.01))  # m/s; s of a readout
_REAL_IMAGES = 60  # of a board

OTHERS = "others"
"""The bench of conditions that no bench has."""
SPOILT = ("lens", "garbage", "bodies", "facades", "near")
"""Benches of frames whose errors are not compared: some of them should have no pose."""

# The phone's, measured by its images and its gyroscope without this package.
_PHONE = NodeConfig(readout_time=0.0318, stamp_offset=-0.0028)
_WEBCAM_READOUT, _TAGS_READOUT = 0.011, 0.02  # s; a global shutter's is wrong, as users set it


def benches() -> Iterator[Condition]:
    """Some conditions of each bench, the same ones as long as a bench has the same names."""
    every = [one for one in conditions() if one.sequence.length <= _LONGEST]
    for bench, count in _OF_BENCH.items():
        those = [one for one in every if one.bench == bench]
        rng = np.random.default_rng(zlib.crc32(bench.encode()))
        for k in sorted(rng.permutation(len(those))[:count]):
            sequence = those[k].sequence
            first, last = sequence.counted
            counted = (max(first, last - _COUNTED), last)
            yield replace(those[k], sequence=replace(sequence, counted=counted))


def others() -> Iterator[Condition]:
    """Shaken hands, flights, waves, shifts and scenes that no bench has: 25."""

    def shown(
        name: str, motion: Motion, scene: Scene, *, tracked: bool = False, **others: Any
    ) -> Condition:
        sequence = TRACKED if tracked else SINGLE
        name += "/tracked" * tracked
        return Condition(OTHERS, name, motion, scene, 0.5, sequence=sequence, **others)

    shakes = {
        "slow": ((0.3, 8.0),), "fast": ((0.05, 120.0),), "two": ((0.1, 25.0), (0.03, 150.0)),
    }  # fmt: skip
    for (name, shaking), tracked in product(shakes.items(), (False, True)):
        shaken = moving("shaken_hand", shaking=shaking)
        yield shown(f"shaken {name}", shaken, Rich(120), tracked=tracked)
    for (speed, readout), tracked in product(_FLIGHTS, (False, True)):
        flight, camera = moving("steady", rate=0.3, speed=speed), Camera(readout_time=readout)
        yield shown(f"flight {speed:g}m/s", flight, Rich(120), tracked=tracked, camera=camera)
    for (scene, of), tracked in product(SEEN.items(), (False, True)):
        declared = {"points": Points(bent_map=0.005), "settings": (("map_deviation", 0.005),)}
        yield shown(f"waves/{scene}", HAND, of, tracked=tracked, **declared)
    yield shown("waves/lens", HAND, Rich(120), calibration=Calibration(distortion=0.3))
    for share, shift in ((0.2, 6.0), (0.3, 12.0)):
        shifted = Points(alike=(share, shift))
        yield shown(f"shift {share:.0%} by {shift:g}px", HAND, Rich(), points=shifted)
    yield shown("shift all by 1px", HAND, Rich(), points=Points(shift=1.0))
    yield shown("shift all by 1px", HAND, Wall(), points=Points(shift=1.0), tracked=True)
    yield shown("plane near", SLOW_HAND, SmallPlane(0.3, 1.0, 40.0))
    yield shown("plane far", SLOW_HAND, SmallPlane(0.3, 3.0, 20.0), camera=NARROW)
    yield shown("markers", SLOW_HAND, Board(markers=True), tracked=True)
    yield shown("board bent", SLOW_HAND, Board(bend=5e-4))


def spoilt() -> Iterator[tuple[int, Condition]]:
    """Conditions of single frames of which some should have no pose, and how many frames."""

    def of(kind: str, name: str, motion: Motion, scene: Scene, points: Points) -> Condition:
        return Condition(kind, name, motion, scene, 0.5, points=points)

    yield 22, of("garbage", "all wrong", HAND, Rich(60), Points(wrong=1.0))
    yield 22, of("garbage", "90% wrong", HAND, Wall(60), Points(wrong=0.9))
    fast = turning(15.0)
    for share in (0.40, 0.45):
        yield 16, of("bodies", f"{share:.0%}", fast, Rich(100), Points(body=share))
    for count in (40, 80):  # by 17 px, which a motion of 10 deg in a readout may explain
        yield 10, of("facades", f"{count}", HAND, Wall(count), Points(slip=(0.3, 0.1)))
    yield 20, of("near", "mismatches", HAND, Rich(100), Points(near=(0.45, 20.0)))
    yield 10, of("near", "map", HAND, Wall(100), Points(rough_map=0.018))  # 3 px at 2.5 m
    yield 10, of("near", "alike", HAND, Rich(100), Points(alike=(0.4, 8.0)))


def judged(seed: int, only: Sequence[str] = ()) -> Iterator[tuple[str, Judged]]:
    """All simulated frames, or those of some benches, by ``bench/condition``."""
    made: list[tuple[str, Callable[[], Judged]]] = []
    for one in (*benches(), *others()):
        frames = _FRAMES if one.sequence.length == 1 else _RECORDINGS
        made.append((f"{one.bench}/{one.name}", partial(judge, one, frames, seed, {})))
    for frames, one in spoilt():
        made.append((f"{one.bench}/{one.name}", partial(judge, one, frames, seed, {})))
    scenes = ("corner", "volume", "markers")
    for scene, fault in product(scenes, ("focal length", "binned twice", "ROI twice")):
        made.append((f"lens/{scene}, {fault}", partial(_gross, scene, fault, 8, seed)))
    for scene in scenes:
        fault = "half moved"
        made.append((f"garbage/{scene}, {fault}", partial(_gross, scene, fault, 22, seed)))
    for name, make in made:
        if not only or name.split("/")[0] in only:
            yield name, make()


def _gross(scene: str, fault: str, frames: int, seed: int) -> Judged:
    """Frames of :mod:`benchmarks.frames.gross`."""
    key = zlib.crc32(f"{scene}/{fault}".encode())
    random, figures, reasons = np.random.default_rng([seed, key]), [], []
    for k in range(frames):
        camera, points, pixels, rotation = gross.frame(scene, fault, random)
        start = time.process_time()
        result = rsl.Localizer(camera).localize(points, pixels)
        taken = 1e3 * (time.process_time() - start)
        scores = [math.nan] * 13
        if result:
            pose, turn, way, deg, mm = of_pose(pose_at(result, 0.0), (rotation.T, np.zeros(3)))
            nothing = [math.nan] * 2
            scores = [pose, pose, math.nan, turn, turn, way, *nothing, deg, deg, mm, *nothing]
        figures.append([k, taken, *scores])
        reasons.append("" if result else str(result.reason))
    return Judged(np.array(figures), reasons)


def boards(folder: Path | None, cache: Path) -> Iterator[tuple[str, float]]:
    """Images of two bundled boards, and of videos in a folder, that each method localizes, and its
    jitter (second differences of the orientation, median) over solvePnP's.
    """
    bundled = {
        "webcam": (data.path(data.WEBCAM), _WEBCAM_READOUT),
        "tags": (GLOBAL_SHUTTER_TAGS, _TAGS_READOUT),
    }
    shown: list[tuple[Clip, rsl.Camera, NodeConfig]] = []
    for name, (path, readout) in bundled.items():
        config = NodeConfig(readout_time=readout)
        recording = read_bag(path, config)
        shown.append((_clip(name, recording), recording.camera, config))
    for clip in () if folder is None else clips_of(folder, cache, _REAL_IMAGES, []):
        shutter = shutter_of(clip, cache)
        lens = replace(opencv_lens(clip), readout_time=shutter.readout_time,
                       scan_direction=shutter.scan_direction)  # fmt: skip
        shown.append((clip, lens, NodeConfig(readout_time_deviation=shutter.deviation)))
    for clip, camera, config in shown:
        peer = localized(PEER, camera, clip.images, config)
        for method in METHODS:
            poses = localized(method, camera, clip.images, config)
            yield f"{clip.name}/{method}/localized", sum(map(bool, poses)) / len(poses)
            yield f"{clip.name}/{method}/jitter", jitter(clip, poses, peer)["turn50"]


def _clip(name: str, recording: Recording) -> Clip:
    images = [ImagePoints(each.middle_ns, each.points, each.pixels) for each in recording.frames]
    images = images[:_REAL_IMAGES]
    interval = 1e-9 * float(np.median(np.diff([image.stamp_ns for image in images])))
    camera = recording.camera
    return Clip(name, images, (camera.width, camera.height), interval)


def phone_folder(root: Path) -> Path | None:
    """The phone's recording: the bundled one, else that of a folder ``shared`` beside; or None."""
    places = [root / "benchmarks", *(parent / "shared" for parent in root.parents)]
    folders = (place / "data" / "phone_gyro" for place in places)
    return next((folder for folder in folders if (folder / "gyroscope.txt").exists()), None)


def phone(folder: Path) -> Iterator[tuple[str, float]]:
    """Errors of turn rates before a phone's gyroscope, deg/s, and points within 1 px.

    ``folder`` holds ``gyroscope.txt`` and ``recording``, as bundled, or all of it as ``rec``
    (:mod:`benchmarks.real.gyro`).
    """
    whole = folder / "rec"
    recording = read_bag(whole if whole.is_dir() else folder / "recording", _PHONE)
    rows = gyro.judge(recording, Gyroscope.read(folder / "gyroscope.txt"), _PHONE).rows
    for name in (gyro.SINGLE, gyro.TRACKED):
        row = rows[name]
        twist = row.twist or (math.nan, math.nan)
        for label, pair in (("twist", twist), ("turns", row.between)):
            for part, value in zip(("", " 95 %"), pair, strict=True):
                yield f"phone/{name}/{label}{part}", value
        yield f"phone/{name}/localized", row.localized / len(recording.frames)
        yield f"phone/{name}/1 px", row.near
        yield f"phone/{name}/1 px, fastest", row.near_fastest
