# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a calibration means, in words."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.tools.calibration import Calibration

# Beyond this (s rms) the images' own times are worth a word.
_WORTH_A_WORD = 5e-4
# A ninth of the image is not covered where no keypoint lies in more than this part of its cells,
# of which there are so many along each side.
_EMPTY, _CELLS = 0.5, 3
_REGIONS = (
    ("top left", "top", "top right"), ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)  # fmt: skip


def readout_time(result: Calibration) -> float:
    """The readout time (s) to be set: 0 for a global shutter."""
    return 0.0 if result.global_shutter else abs(result.readout_time)


def sense(result: Calibration) -> float:
    """The sign by which the readout times of parts are those along :func:`scan_direction`."""
    return 1.0 if result.global_shutter else float(np.copysign(1.0, result.readout_time))


def scan_direction(result: Calibration) -> ScanDirection:
    """The direction that the sign of the readout time says."""
    given = ScanDirection(result.fit.camera.scan_direction)
    return given if result.global_shutter or result.readout_time > 0.0 else REVERSED[given]


def lens_refusal(result: Calibration) -> str:
    """One line with the figure when the recording determines no lens; or ''."""
    camera = result.fit.camera
    if np.all((camera.K[:2, 2] > 0.0) & (camera.K[:2, 2] < camera.size)):
        return ""
    return (
        f"no lens: the principal point would be at {camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f}, "
        "outside the image; show the map from several sides, in all parts of the image"
    )


def refusal(result: Calibration) -> str:
    """One line with the figure when lens or readout time is not determined; or ''."""
    return lens_refusal(result) or result.disbelief(sense(result))


def shape_is_free(result: Calibration) -> bool:
    """Whether the map's shape was estimated."""
    return result.fit.freedom.landmarks > 0.0


def moved(result: Calibration, points: Array) -> Array:
    """Points (n,3) of the map where they were found; those that no image shows stay."""
    rows = {tuple(place): row for row, place in enumerate(result.posed.observations.landmarks)}
    places = [rows.get(tuple(point)) for point in points]
    return np.array([
        point if row is None else result.fit.state.landmarks[row]
        for point, row in zip(points, places, strict=True)
    ])  # fmt: skip


def remarks(result: Calibration) -> list[str]:
    """Sentences on what is odd, and on what the value is worth."""
    said = []
    if result.global_shutter:
        said.append(
            f"global shutter: 0 lies within the error of {1e3 * result.readout_time:+.3f} +- "
            f"{1e3 * result.deviation:.3f} ms"
        )
    elif not refusal(result):
        said.append(f"direction: the reversed one is 10^{result.odds:.0f} times less likely")
    if result.stamps.irregular:
        said.append(
            f"stamps are irregular: {1e3 * result.stamps.jitter:.2f} ms rms about even intervals"
        )
    if result.jitter > _WORTH_A_WORD:
        said.append(
            f"exposures are {1e3 * result.jitter:.1f} ms rms off their stamps; their times were "
            "estimated, and the value depends on the mean interval"
        )
    if result.stamps.missing:
        said.append(f"{result.stamps.missing} images are missing between the others")
    if result.inflation > 1.0:
        said.append(
            f"parts of the recording differ ({result.parts(sense(result))} ms) by more than their "
            "noise: the "
            f"deviation is {result.inflation:.1f} times that of the noise alone"
        )
    if result.held:
        said.append(
            f"the map's {result.held} points are taken as they are given: more than are estimated "
            "along; where they may be off by a thousandth of its size, show a smaller board"
        )
    if regions := uncovered(result):
        said.append(
            f"never showed the map: {regions[0]} of the image ({', '.join(regions[1:])}); the lens "
            "is a guess there"
        )
    return said


def uncovered(result: Calibration) -> list[str]:
    """How much of the image no keypoint covers, and where that is; empty: hardly any."""
    observations, camera = result.posed.observations, result.fit.camera
    pixels = observations.pixels[observations.trusted]
    cells = (pixels / camera.size * _CELLS * 3).astype(int).clip(0, 3 * _CELLS - 1)
    empty = np.ones((3 * _CELLS, 3 * _CELLS), np.bool_)
    empty[cells[:, 1], cells[:, 0]] = False
    regions = empty.reshape(3, _CELLS, 3, _CELLS).mean(axis=(1, 3))
    names = [
        name
        for row, line in zip(regions, _REGIONS, strict=True)
        for share, name in zip(row, line, strict=True)
        if share > _EMPTY
    ]
    return [f"{empty.mean():.0%}", *names] if names else []
