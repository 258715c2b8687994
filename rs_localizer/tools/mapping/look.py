# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The images of a recording that a map is made from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.offline.detect import Cameras
from rs_localizer.offline.image_sources import Carried, Shot
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.tools.mapping.build import check_features
from rs_localizer.tools.mapping.views import Looker, View

# After so many, images without features are refused: two seconds of a usual video.
_EARLY_VIEWS = 30
# Images a hair before their time are in time.
_EARLY = 0.9


@dataclass(slots=True)
class Looked:
    """What was seen."""

    views: list[View] = field(default_factory=list)
    camera: Camera | None = None  # without its readout time; None: nobody has calibrated it
    images: int = 0
    moments: dict[float, int] = field(default_factory=dict)  # asked for, s -> row of its view
    refused: dict[str, str] = field(default_factory=dict)  # the first detail of each reason
    stamps_ns: list[int] = field(default_factory=list)

    @property
    def period(self) -> float:
        """s from one image to the next, median; NaN for a single one."""
        return float(np.median(np.diff(self.stamps_ns))) * 1e-9 if self.stamps_ns[1:] else np.nan


def look(
    shots: Iterable[Shot | Carried], looker: Looker, rate: float, moments: Sequence[float],
    done: Callable[[], object],
) -> Looked:  # fmt: skip
    """Look at the images that are kept: so many a second, and the first ones at or after moments.

    Args:
        moments: s after the first image.
        done: called after each image.

    Raises:
        ValueError: for a camera that changes, or images without features.
    """
    found, cameras, size = Looked(), Cameras(ScanDirection.TOP_TO_BOTTOM), None
    for shot in shots:
        if isinstance(shot, Carried):
            continue
        found.images += 1
        done()
        image = shot.image
        if isinstance(image, Refusal):
            found.refused.setdefault(image.reason, image.detail)
            continue
        camera = None if shot.camera_info is None else cameras.of(shot, image)
        if size not in (None, image.pixels.shape) or (found.views and camera is not found.camera):
            raise ValueError("the camera changes within the recording; cut it there")
        found.camera, size = camera, image.pixels.shape
        found.stamps_ns.append(image.stamp_ns)
        since = (image.stamp_ns - found.stamps_ns[0]) * 1e-9
        asked = [s for s in moments if s not in found.moments and since >= s - 1e-3]
        found.moments |= dict.fromkeys(asked, len(found.views))
        due_ns = 1e9 * _EARLY / rate
        if asked or not found.views or image.stamp_ns - found.views[-1].stamp_ns >= due_ns:
            found.views.append(looker.look(image))
            if len(found.views) == _EARLY_VIEWS:
                check_features(found.views)
    return found
