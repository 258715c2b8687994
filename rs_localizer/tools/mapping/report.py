# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Table and advice on a map that was built."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rs_localizer.core.arrays import BoolArray
from rs_localizer.tools.mapping.build import Built
from rs_localizer.tools.mapping.map_keypoints import MapObservations
from rs_localizer.tools.mapping.seen_images import SeenImage

# Advice is given where more than this share of the images is blurred or has no pose.
_MANY = 0.1
# A walk comes back if this share of what its last images show was shown by its first ones, a tenth
# of all each. What lies between holds together by neighbours alone, whose errors add up.
_AGAIN, _ENDS = 0.1, 0.1


def rows(built: Built, images: int, views: int) -> list[tuple[str, str]]:
    """Return the table of results: name and text.

    Args:
        images: of the recording.
        views: of them that were looked at.
    """
    refined, covariances, structure = built.refined, built.landmarks.covariances, built.structure
    modes = built.landmarks.error_modes
    assert covariances is not None
    assert modes is not None
    spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    shared = np.linalg.norm(modes, axis=(1, 2))
    unit = "mm" if built.placement.scaled else "units of the map / 1000"
    joined = f"{structure.parts[0]} of {len(built.keyframes)}"
    others = structure.parts[1:]
    return [
        ("images", f"{images}, {views} used"),
        ("keyframes registered by COLMAP", joined + (f"; other parts: {others}" if others else "")),
        ("reprojection error of COLMAP", f"{structure.error:.2f} px (mean)"),
        ("images with a pose", f"{len(built.posed)} of {views}"),
        ("landmarks", f"{len(built.landmarks)} of {len(structure.start.points)} points"),
        ("deviation of a landmark", f"{1e3 * np.median(spread):.1f} {unit} (median)"),
        ("deviation that landmarks share", f"{1e3 * np.median(shared):.1f} {unit} (median)"),
        ("noise before the refinement", f"{refined.before:.2f} px"),
        ("noise after it", f"{refined.after:.2f} px"),
        *_of_shutter(built),
        ("lens", _lens(built)),
        ("scale", built.placement.basis),
        ("z is up", built.placement.up),
    ]


def advice(built: Built, views: Sequence[SeenImage]) -> list[str]:
    """Return sentences on how to film a better map."""
    assert built.landmarks.error_modes is not None
    said = []
    posed = np.zeros(len(views), np.bool_)
    posed[built.posed] = True
    start = views[0].stamp_ns
    seconds = np.array([1e-9 * (view.stamp_ns - start) for view in views])
    if np.mean(~posed) > _MANY:
        said.append(f"{_when(~posed, seconds)}, images have no pose: film there more slowly")
    if len(built.structure.parts) > 1:
        said.append(
            f"{sum(built.structure.parts[1:])} keyframes are not connected with the others: film "
            "what lies between, and come back to where you began"
        )
    if not comes_back(built.structure.seen):
        shared = 1e3 * np.median(np.linalg.norm(built.landmarks.error_modes, axis=(1, 2)))
        unit = "mm" if built.placement.scaled else "thousandths of the map's unit"
        said.append(
            f"the last images show nothing that the first ones do: landmarks share errors of "
            f"{shared:.1f} {unit}, larger ones towards the ends; come back to where you began, or "
            "show markers at both ends"
        )
    shutter = built.shutter
    known = shutter.visible if shutter else not built.refined.apart
    if not known:
        said.append(
            "for the readout time, film at the camera's own rate (no time lapse, no stabilization) "
            "and rotate the camera quickly, sideways and up and down, for some seconds"
        )
    return said


def comes_back(seen: MapObservations) -> bool:
    """Return whether the last images show landmarks that the first ones show."""
    count = len(seen.stamps_ns)
    ends = max(1, round(_ENDS * count))
    first = np.unique(seen.landmarks[seen.images < ends])
    last = np.unique(seen.landmarks[seen.images >= count - ends])
    return len(np.intersect1d(first, last)) >= _AGAIN * min(len(first), len(last))


def _of_shutter(built: Built) -> list[tuple[str, str]]:
    fit, known = built.shutter, built.camera.readout_time
    if fit is None:
        text = f"{1e3 * known:.2f} ms (given)" if known else "unknown, or none"
        if built.refined.apart:
            text = "invisible: no smooth motion joins the images, each has a pose of its own"
        return [("readout time", text)]
    best = f"{1e3 * fit.readout_time:.2f} +- {1e3 * fit.deviation:.2f} ms, {fit.direction}"
    why = "" if fit.possible else f", longer than {1e3 * fit.interval:.1f} ms between images"
    noises = (
        f"{fit.noise:.3f} px, with a global shutter {fit.global_noise:.3f} px; "
        f"{100 * fit.better_images:.0f} % of the images fit better"
    )
    if fit.visible:
        return [("readout time", f"{best} (estimated)"), ("noise with that", noises)]
    return [
        ("readout time", f"invisible in these images (best fit {best}{why})"),
        ("noise with that", noises),
    ]


def _lens(built: Built) -> str:
    camera = built.camera
    if camera.K[0, 0] == built.structure.camera.K[0, 0]:
        return "as calibrated"
    coefficients = ", ".join(f"{value:.4f}" for value in camera.D)
    return (
        f"estimated: focal length {camera.K[0, 0]:.1f}, {camera.K[1, 1]:.1f} px, centre "
        f"{camera.K[0, 2]:.1f}, {camera.K[1, 2]:.1f} px, distortion {coefficients}"
    )


def _when(rows: BoolArray, seconds: np.ndarray) -> str:
    """Return the times of views as a sentence: at most three stretches, the longest ones."""
    marks = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(int)))
    parts = sorted(zip(marks[::2], marks[1::2] - 1, strict=True), key=lambda p: p[0] - p[1])[:3]
    return "from " + ", ".join(f"{seconds[a]:.1f} to {seconds[b]:.1f} s" for a, b in sorted(parts))
