# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibrations of parts of each video against each other, and their lenses against OpenCV's.

Halves and thirds of a video are calibrated on their own. Readout times that are accepted are held
against each other by their deviations; lenses by the images that neither has seen, each of which
has the global-shutter pose that fits it best.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.real.clips import Clip, opencv_lens
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.tools import verdict
from rs_localizer.tools.adjust.observe import Observed
from rs_localizer.tools.calibration import calibrate
from rs_localizer.tools.first_lens import first_lens, reprojection_error

Result = dict[str, Any]
PARTS = ("whole", "1/2", "2/2", "1/3", "2/3", "3/3")


def part_of(images: Sequence[Observed], part: str) -> list[Observed]:
    """``whole``, or as ``2/3`` the second third of the images."""
    if part == "whole":
        return list(images)
    number, count = (int(word) for word in part.split("/"))
    bounds = np.linspace(0, len(images), count + 1).astype(int)
    return list(images[bounds[number - 1] : bounds[number]])


def calibrated(clip: Clip, cache: Path) -> dict[str, Result]:
    """Each part's calibration, cached."""
    results = {}
    for part in PARTS:
        file = cache / f"{clip.name}_{part.replace('/', 'of')}.json"
        if not file.exists():
            begin = time.process_time()
            result = _calibrated(clip, part_of(clip.images, part))
            result["cpu"] = time.process_time() - begin
            file.write_text(json.dumps(result), encoding="utf-8")
        results[part] = json.loads(file.read_text(encoding="utf-8"))
        print(f"{clip.name:8} {part:6} {summary(results[part])}", flush=True)
    return results


def _calibrated(clip: Clip, images: list[Observed]) -> Result:
    opencv = opencv_lens(clip, images)
    result: Result = {"opencv": {"K": opencv.K.tolist(), "D": opencv.D.tolist()}}
    try:
        camera = first_lens(clip.size, images)
        found = calibrate(camera, images, intrinsics=True, own_stamps=False)
    except ValueError as error:
        return {**result, "refusal": f"none: {error}"}
    lens = found.fit.camera
    board = images[0].points
    return {
        **result,
        "readout_time": found.readout_time,
        "deviation": found.deviation,
        "formal": found.formal_deviation,
        "refusal": verdict.refusal(found),
        "global": found.global_shutter,
        "blocks": [block.readout_time for block in found.blocks],
        "jitter": found.jitter,
        "noise": found.fit.deviation,
        "lens": {"K": lens.K.tolist(), "D": lens.D.tolist(), "model": str(lens.distortion_model)},
        "lens_errors": list(found.lens),
        "board": verdict.moved(found, board).tolist(),
    }


def summary(result: Result) -> str:
    """A calibration in one line."""
    value = "none"
    if "readout_time" in result:
        value = (
            f"{1e3 * result['readout_time']:+7.2f} +- {1e3 * result['deviation']:.2f} ms"
            f" (noise {1e3 * result['formal']:.2f})"
        )
    return f"{value}  {result['refusal'] or 'accepted'} [{result['cpu']:.0f} s]"


def pairs(results: dict[str, Result]) -> list[float]:
    """By how many deviations accepted readout times differ: of parts, and of these and the whole.

    Parts that share images differ by less than these deviations say.
    """
    accepted = [result for result in results.values() if not result["refusal"]]
    return [
        (a["readout_time"] - b["readout_time"]) / math.hypot(a["deviation"], b["deviation"])
        for a, b in combinations(accepted, 2)
    ]


def unseen_errors(clip: Clip, results: dict[str, Result], parts: int) -> list[Array]:
    """Error (px rms) of the images that a part has not seen.

    Returns:
        For each part: OpenCV's lens, ours before the same flat board, ours with its own board.
    """
    rows = []
    for number in range(parts):
        name = f"{number + 1}/{parts}"
        result = results[name]
        unseen = [
            image
            for other in range(parts)
            if other != number
            for image in part_of(clip.images, f"{other + 1}/{parts}")
        ]
        of_opencv = result["opencv"]
        opencv = Camera(*clip.size, K=np.array(of_opencv["K"]), D=np.array(of_opencv["D"]))
        row = [_error(opencv, unseen), math.nan, math.nan]
        if lens := result.get("lens"):
            own = Camera(
                *clip.size, K=np.array(lens["K"]), D=np.array(lens["D"]),
                distortion_model=lens["model"],
            )  # fmt: skip
            board = np.array(result["board"])
            row[1:] = _error(own, unseen), _error(own, [replace(i, points=board) for i in unseen])
        rows.append(np.array(row))
    return rows


def _error(camera: Camera, images: Sequence[Observed]) -> float:
    errors = np.array([reprojection_error(camera, image) for image in images[::3]])
    return float(np.sqrt(np.mean(errors**2)))


def report(clips: Sequence[Clip], cache: Path) -> str:
    """All of it as text."""
    lines, chis, wins, cases = [], [], 0, 0
    for clip in clips:
        results = calibrated(clip, cache)
        lines += [f"{clip.name:8} {part:6} {summary(results[part])}" for part in PARTS]
        chis += pairs(results)
        for parts in (2, 3):
            for number, row in enumerate(unseen_errors(clip, results, parts)):
                cases += parts == 2
                wins += parts == 2 and bool(row[2] <= row[0])
                lines.append(
                    f"{clip.name:8} {number + 1}/{parts} lens on unseen images: OpenCV "
                    f"{row[0]:.3f}, ours {row[1]:.3f}, with its board {row[2]:.3f} px"
                )
    rms = math.sqrt(float(np.mean(np.square(chis)))) if chis else math.nan
    lines += [
        f"accepted pairs: {len(chis)}, differences over deviations {rms:.2f} rms",
        f"lens with its board no worse than OpenCV's: {wins} of {cases} halves",
    ]
    return "\n".join(lines)
