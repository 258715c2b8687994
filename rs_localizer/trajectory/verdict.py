# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a calibration means, in words."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.trajectory.calibration import Calibration
from rs_localizer.trajectory.online_readout import REVERSED

# Of the images' own times (s rms): beyond the first they are worth a word, beyond the second the
# stamps are none that a camera gave.
_WORTH_A_WORD, _MOST_JITTER = 5e-4, 1e-3
# Readouts cannot take longer than this part of the interval between images.
_LONGEST = 1.05
# A ninth of the image is not covered where no keypoint lies in more than this part of its cells,
# of which there are so many along each side.
_EMPTY, _CELLS = 0.5, 3
_REGIONS = (
    ("top left", "top", "top right"), ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)  # fmt: skip


def readout_time(found: Calibration) -> float:
    """The readout time (s) to be set: 0 for a global shutter."""
    return 0.0 if found.global_shutter else abs(found.readout_time)


def scan_direction(found: Calibration) -> ScanDirection:
    """The direction that the sign of the readout time says."""
    given = ScanDirection(found.fit.camera.scan_direction)
    return given if found.global_shutter or found.readout_time > 0.0 else REVERSED[given]


def lens_refusal(found: Calibration) -> str:
    """One line with the figure when the recording determines no lens; or ''."""
    camera = found.fit.camera
    if np.all((camera.K[:2, 2] > 0.0) & (camera.K[:2, 2] < camera.size)):
        return ""
    return (
        f"no lens: the principal point would be at {camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f}, "
        "outside the image; show the map from several sides, in all parts of the image"
    )


def refusal(found: Calibration) -> str:
    """One line with the figure when lens or readout time is not determined; or ''."""
    value = f"{1e3 * found.readout_time:.1f} +- {1e3 * found.deviation:.1f} ms"
    if text := lens_refusal(found):
        return text
    if found.stabilised:
        return (
            f"not observable: {value}; parts of the recording disagree ({_parts(found)} ms): is "
            "image stabilisation on, or was the video processed?"
        )
    if found.jitter > _MOST_JITTER:
        return (
            f"not observable: {value}; images were exposed {1e3 * found.jitter:.1f} ms rms beside "
            "their stamps: record with the camera's own time stamps, without losing images or "
            "encoding the video anew"
        )
    if abs(found.readout_time) > _LONGEST * found.stamps.interval:
        return (
            f"not observable: {value} is longer than the interval between images, "
            f"{1e3 * found.stamps.interval:.1f} ms: are the stamps, or the frame rate, right?"
        )
    if not found.long_enough:
        return (
            f"not observable: {value}; {found.telling} of {len(found.blocks)} parts of the "
            f"{found.seconds:.1f} s determine it on their own, three have to, or 9 s: move the "
            "camera faster and for longer"
        )
    if not found.determined:
        return (
            f"not observable: {value}, known to less than {1e3 * found.limit:.1f} ms it would be; "
            "move the camera faster, turn it to and fro about all axes, and for longer"
        )
    if found.too_fast:
        return (
            f"not observable: {value}; no rolling shutter is that fast: was the video stabilised "
            "or processed?"
        )
    if found.near_zero and not found.global_shutter:
        reason = (
            "three deviations are more than 2 ms" if found.inflation == 1.0 and found.own_stamps
            else "its parts differ" if found.own_stamps
            else "the stamps are those of a constant rate, as of a video that was processed"
        )  # fmt: skip
        return f"not observable: {value}; that is no proof of a global shutter: {reason}"
    return ""


def shape_is_free(found: Calibration) -> bool:
    """Whether the map's shape was estimated."""
    return found.fit.freedom.landmarks > 0.0


def moved(found: Calibration, points: Array) -> Array:
    """Points (n,3) of the map where they were found; those that no image shows stay."""
    rows = {tuple(place): row for row, place in enumerate(found.posed.observations.landmarks)}
    places = [rows.get(tuple(point)) for point in points]
    return np.array([
        point if row is None else found.fit.state.landmarks[row]
        for point, row in zip(points, places, strict=True)
    ])  # fmt: skip


def remarks(found: Calibration) -> list[str]:
    """Sentences on what is odd, and on what the value is worth."""
    said = []
    if found.global_shutter:
        said.append(
            f"global shutter: 0 lies within the error of {1e3 * found.readout_time:+.3f} +- "
            f"{1e3 * found.deviation:.3f} ms"
        )
    elif not refusal(found):
        said.append(f"direction: the reversed one is 10^{found.odds:.0f} times less likely")
    if found.stamps.irregular:
        said.append(
            f"stamps are irregular: {1e3 * found.stamps.jitter:.2f} ms rms about even intervals"
        )
    if found.jitter > _WORTH_A_WORD:
        said.append(
            f"images were exposed {1e3 * found.jitter:.1f} ms rms beside their stamps, each at a "
            "time of its own, which was estimated: the value leans on the mean interval"
        )
    if found.stamps.missing:
        said.append(f"{found.stamps.missing} images are missing between the others")
    if found.inflation > 1.0:
        said.append(
            f"parts of the recording differ ({_parts(found)} ms) by more than their noise: the "
            f"deviation is {found.inflation:.1f} times that of the noise alone"
        )
    if found.held:
        said.append(
            f"the map's {found.held} points are taken as they are given: more than are estimated "
            "along; where they may be off by a thousandth of its size, show a smaller board"
        )
    if regions := uncovered(found):
        said.append(
            f"never showed the map: {regions[0]} of the image ({', '.join(regions[1:])}); the lens "
            "is a guess there"
        )
    return said


def uncovered(found: Calibration) -> list[str]:
    """How much of the image no keypoint covers, and where that is; empty: hardly any."""
    seen, camera = found.posed.observations, found.fit.camera
    pixels = seen.pixels[seen.trusted]
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


def _parts(found: Calibration) -> str:
    return ", ".join(f"{1e3 * block.readout_time:.2f}" for block in found.blocks)
