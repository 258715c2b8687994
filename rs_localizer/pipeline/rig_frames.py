# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of several cameras become frames: by their stamps, however fast they come.

A frame holds one image of each camera whose exposures have their middles within ``rig.window``. It
is complete when all cameras that are awaited have come, or when one comes that belongs to the next
frame. A camera that has been missing from some frames in a row is no longer awaited until it comes
again. What is left out is said: an image that comes after its frame, and one of a clock that is
ahead of the others, or has gone back alone. When all clocks go back, a recording has started over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Notice
from rs_localizer.core.rig import ByCamera, RigEstimate
from rs_localizer.io.clouds import Correspondences
from rs_localizer.io.outputs import CameraShare
from rs_localizer.pipeline.refusal import Notify

# Frames in a row without a camera after which it is not awaited: it may have lost one or two.
_ABSENT = 3
# s: what is farther ahead of the last frame is of another clock, if other cameras go on from there.
_LONGEST_STEP = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """Points that one of the cameras saw."""

    camera: str
    start_ns: int  # exposure of the first row
    middle_ns: int  # of the exposure
    cloud: Correspondences


class FrameAssembler:
    """Puts images together.

    Args:
        names: of all cameras, in the order in which a frame has them.
        window: s.
        notice: told which camera is left out, and why.
    """

    def __init__(self, names: Sequence[str], window: float, notice: Notify) -> None:
        self._names, self._window_ns = tuple(names), round(window * 1e9)
        self._notice = notice
        self.reset()

    def reset(self) -> None:
        """Forget all images so far."""
        self._waiting: dict[str, CameraImage] = {}
        self._last_ns: int | None = None  # middle of the latest image of the last frame
        self._stamps: dict[str, int] = {}  # the last of each camera
        self._missed = dict.fromkeys(self._names, 0)  # frames in a row
        self._gone_back: set[str] = set()

    def add(self, image: CameraImage) -> list[list[CameraImage]]:
        """The frames that are complete with this image: none, one or two."""
        if not self._is_usable(image):
            return []
        frames = []
        if not self._belongs(image):
            frames.append(self._complete())
        self._waiting[image.camera] = image
        self._missed[image.camera] = 0
        awaited = [name for name in self._names if self._missed[name] < _ABSENT]
        if all(name in self._waiting for name in awaited):
            frames.append(self._complete())
        return frames

    def flush(self) -> list[list[CameraImage]]:
        """Frames that are left when no more images will come."""
        return [self._complete()] if self._waiting else []

    def _belongs(self, image: CameraImage) -> bool:
        """True if an image is of the frame that waits."""
        return image.camera not in self._waiting and all(
            abs(image.middle_ns - other.middle_ns) <= self._window_ns
            for other in self._waiting.values()
        )

    def _is_usable(self, image: CameraImage) -> bool:
        """True if an image can be of the frame that waits, or of the next one."""
        name, time_ns = image.camera, image.middle_ns
        before = self._stamps.get(name)
        if before is not None and time_ns < before:
            self._gone_back.add(name)
            present = {other for other in self._names if self._missed[other] < _ABSENT}
            if present <= self._gone_back:
                self.reset()
                self._stamps[name] = time_ns
                return True
            self._leave_out(name, f"its stamps went back by {(before - time_ns) * 1e-9:.3f} s")
            return False
        self._stamps[name] = time_ns
        self._gone_back.discard(name)
        waiting = [other.middle_ns for other in self._waiting.values()]
        earliest_ns = min(waiting, default=None)
        if earliest_ns is not None and time_ns < earliest_ns - self._window_ns:
            if self._is_ahead(earliest_ns) and not self._is_ahead(time_ns):
                seconds = (earliest_ns - time_ns) * 1e-9
                for other in list(self._waiting):
                    self._leave_out(other, f"its stamps are {seconds:.3f} s ahead of the others")
                self._waiting = {}
                return True
            self._leave_out(name, f"its image is {(earliest_ns - time_ns) * 1e-9:.3f} s late")
            return False
        if self._last_ns is not None and time_ns <= self._last_ns:
            self._leave_out(name, f"its image is {(self._last_ns - time_ns) * 1e-9:.3f} s late")
            return False
        return True

    def _is_ahead(self, time_ns: int) -> bool:
        return self._last_ns is not None and time_ns - self._last_ns > _LONGEST_STEP * 1e9

    def _complete(self) -> list[CameraImage]:
        """The frame that waits, in the order of the names."""
        frame = [self._waiting[name] for name in self._names if name in self._waiting]
        self._waiting = {}
        self._last_ns = max(image.middle_ns for image in frame)
        for name in self._names:
            self._missed[name] = (
                0 if any(i.camera == name for i in frame) else self._missed[name] + 1
            )
            if self._missed[name] >= _ABSENT:
                self._leave_out(name, f"no image in the last {self._missed[name]} frames")
        return frame

    def _leave_out(self, name: str, why: str) -> None:
        self._notice(Notice.NO_IMAGES, f"{name} is left out: {why}")


def matches_of(cloud: Correspondences, images: Sequence[CameraImage]) -> tuple[Array, ...]:
    """Points and pixels of an image; with scores, where all images have them."""
    if any(image.cloud.scores is None for image in images):
        return cloud.points, cloud.pixels
    assert cloud.scores is not None
    return cloud.points, cloud.pixels, cloud.scores


def joined(names: Sequence[str], images: Sequence[CameraImage]) -> Correspondences:
    """Correspondences of all images with the stamp of the first; ``names``: of all cameras."""
    dropped = sum(image.cloud.dropped for image in images)
    return replace(images[0].cloud, table=_table(names, images), dropped=dropped)


def _table(names: Sequence[str], images: Sequence[CameraImage]) -> NDArray[Any]:
    """The rows of all images, of the fields that all have, and which of the cameras it was."""
    types = [image.cloud.table.dtype for image in images]
    fields = [name for name in types[0].names or () if all(name in (t.names or ()) for t in types)]
    kinds: list[tuple[str, Any]] = [
        (name, np.result_type(*(t[name].newbyteorder("<") for t in types))) for name in fields
    ]
    rows = np.empty(sum(len(image.cloud.table) for image in images), [*kinds, ("camera", "u1")])
    first = 0
    for image in images:
        last = first + len(image.cloud.table)
        for name in fields:
            rows[name][first:last] = image.cloud.table[name]
        rows["camera"][first:last] = names.index(image.camera)
        first = last
    return rows


def share_of(image: CameraImage, result: RigEstimate) -> CameraShare:
    """Contribution of one camera to an estimate."""
    name = image.camera
    assert isinstance(result.inliers, ByCamera)  # as all of a rig
    assert isinstance(result.residuals, ByCamera)
    inliers = result.inliers[name]
    kept = np.asarray(result.residuals[name][inliers])
    rms = float(np.sqrt(kept @ kept / max(len(kept), 1)))
    return CameraShare(name, len(inliers), len(kept), rms, image.start_ns)
