# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos of chessboards: corners, cached, and a lens by OpenCV."""

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rs_localizer.core.arrays import IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.video import Video
from rs_localizer.markers.boards import find_chessboard
from rs_localizer.markers.prints import Chessboard
from rs_localizer.tools import verdict
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.camera_calibration import calibrate
from rs_localizer.tools.first_lens import first_lens

INDEX = "index.csv"
# Of a video whose readout time is not found: that of an ordinary phone, s, give or take.
_PHONE, _PHONE_DEVIATION = 0.015, 0.01
# Images that OpenCV's calibration takes, evenly: more only take time.
_CALIBRATION_IMAGES = 50
_FEWEST = 20  # images that two halves of the bootstrap's blocks need


@dataclass(frozen=True, slots=True)
class Clip:
    """The images of one video that show the board."""

    name: str
    images: list[ImagePoints]
    size: tuple[int, int]
    interval: float  # s, median


def clips_of(folder: Path, cache: Path, most: int, only: list[str]) -> list[Clip]:
    """The videos of a folder.

    Args:
        folder: with ``index.csv``: file, inner corners (8x6), side of a square in metres.
        cache: where corners are kept.
        most: images of each that show the board.
        only: names without suffix; empty: all.
    """
    cache.mkdir(parents=True, exist_ok=True)
    with (folder / INDEX).open(encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    clips = []
    for name, corners, square in rows:
        if only and Path(name).stem not in only:
            continue
        columns, lines = (int(word) for word in corners.split("x"))
        board, path = Chessboard(columns, lines, float(square)), folder / name
        clip = _clip_of(path, board, cache, most)
        if len(clip.images) < _FEWEST:
            print(f"{name}: {len(clip.images)} images show a board of {corners} corners: left out")
        else:
            clips.append(clip)
    return clips


def _clip_of(path: Path, board: Chessboard, cache: Path, most: int) -> Clip:
    """So many images of a video that show a board; corners are kept in ``cache``."""
    file = cache / f"{path.stem}_corners.npz"
    if not file.exists():
        _detect(path, board, file)
    stored = np.load(file)
    # x along the rows, y down, z away from the viewer: the first corner is the origin.
    points = (board.points - board.points[0]) @ np.diag([1.0, -1.0, -1.0])
    times = stored["times"][:most]
    images = [
        ImagePoints(round(1e9 * time), points, pixels)
        for time, pixels in zip(times, stored["pixels"], strict=False)
    ]
    width, height = stored["size"].tolist()
    return Clip(path.stem, images, (width, height), float(np.median(np.diff(times))))


def _detect(path: Path, board: Chessboard, file: Path) -> None:
    times, corners, shown, previous, size = [], [], [], None, (0, 0)
    for shot in Video(path):
        size = shot.image.shape[::-1]
        pixels = find_chessboard(shot.image, board, previous)
        times.append(math.nan if shot.seconds is None else shot.seconds)
        if pixels is not None:
            shown.append(len(times) - 1)
            corners.append(pixels)
            previous = pixels
    seconds = np.array(times)
    if not np.all(np.diff(seconds) > 0.0):  # some are missing
        seconds = np.arange(len(seconds)) * np.nanmedian(np.diff(seconds))
    np.savez(file, times=seconds[shown], pixels=corners, size=size)


def opencv_lens(clip: Clip) -> Camera:
    """The lens that ``cv2.calibrateCamera`` finds on some of the images."""
    chosen = clip.images
    picks = np.unique(np.linspace(0, len(chosen) - 1, _CALIBRATION_IMAGES).astype(int))
    points = [np.asarray(chosen[k].points, np.float32) for k in picks]
    pixels = [np.asarray(chosen[k].pixels, np.float32) for k in picks]
    _, K, D, _, _ = cv2.calibrateCamera(points, pixels, clip.size, None, None)
    return Camera(width=clip.size[0], height=clip.size[1], K=K, D=np.asarray(D).ravel()[:5])


@dataclass(frozen=True, slots=True)
class Shutter:
    """What the package's calibration says of a clip."""

    readout_time: float  # s
    deviation: float  # s
    scan_direction: str
    verdict: str  # in a few words


def shutter_of(clip: Clip, cache: Path) -> Shutter:
    """The package's own calibration of lens and readout time, cached: it takes a minute."""
    file = cache / f"{clip.name}_calibration.json"
    if not file.exists():
        file.write_text(json.dumps(_calibrated(clip)), encoding="utf-8")
    found = json.loads(file.read_text(encoding="utf-8"))
    known = found["readout_time"] > 1e-3
    return Shutter(
        found["readout_time"] if known else _PHONE, 0.0 if known else _PHONE_DEVIATION,
        found["direction"] if known else "top_to_bottom", found["verdict"],
    )  # fmt: skip


def _calibrated(clip: Clip) -> dict[str, object]:
    try:
        found = calibrate(first_lens(clip.size, clip.images), clip.images, intrinsics=True)
    except ValueError as error:
        return {"readout_time": 0.0, "direction": "", "verdict": f"none: {error}"}
    value = f"{1e3 * found.readout_time:+.2f} +- {1e3 * found.deviation:.2f} ms"
    refusal = verdict.lens_refusal(found) or found.disbelief
    return {
        "readout_time": 0.0 if refusal else verdict.readout_time(found),
        "direction": str(verdict.scan_direction(found)),
        "verdict": f"refused, {value}" if refusal else value,
    }


def halved(count: int, seed: int) -> tuple[IntArray, IntArray]:
    """Two random halves of so many corners, as indices."""
    order = np.random.default_rng(seed).permutation(count)
    return np.sort(order[: count // 2]), np.sort(order[count // 2 :])
