# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The map that keypoints are matched with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.estimation.calibration import ErrorModes
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.clouds import Correspondences, Keypoints
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.pipeline.refusal import Notify, Refusal

if TYPE_CHECKING:  # without a map nobody needs it
    from rs_localizer.matching import MatchBy, Matcher


class Landmarks:
    """The map that keypoints are matched with, as soon as there is one.

    Args:
        notice: called with oddities.
    """

    def __init__(self, notice: Notify) -> None:
        self._notice = notice
        self._matcher: Matcher | None = None
        self.error_modes: ErrorModes | None = None
        self._last: tuple[Keypoints, Correspondences] | None = None  # of a camera alone
        self.lacking = False
        """Whether keypoints have come before a map, and no frame has been localized since."""

    @property
    def map(self) -> Map | None:
        """The present one."""
        return None if self._matcher is None else self._matcher.map

    def use_map(self, landmarks: Map) -> None:
        """Match with this map from now on."""
        previous = self.map
        if previous is not None and landmarks.equals(previous):
            return  # published again
        if landmarks.dropped:
            self._notice(
                Notice.MAP_INCOMPLETE,
                f"{landmarks.dropped} landmarks are left out: they hold NaN or infinity, or no "
                "descriptor",
            )
        if previous is not None:
            self._notice(
                Notice.MAP_REPLACED,
                f"a map of {len(landmarks)} landmarks in frame {landmarks.frame!r} replaces the "
                f"one of {len(previous)} in frame {previous.frame!r}",
            )
        from rs_localizer.matching import Matcher

        self._matcher, self._last = Matcher(landmarks), None
        modes = landmarks.error_modes
        self.error_modes = None if modes is None else ErrorModes(landmarks.points, modes)
        self.lacking = False

    def matching_by(self, keypoints: Keypoints) -> MatchBy | Refusal:
        """Return the means by which keypoints can be matched."""
        if self._matcher is None:
            self.lacking = True
            return Refusal(
                Reason.NO_MAP, "no usable map has come yet, on map_points or as map_file"
            )
        from rs_localizer.matching import MOST_KEYPOINTS, MatchBy, MatchError

        try:
            by = self._matcher.choose(keypoints)
        except MatchError as error:
            return Refusal(Reason.BAD_KEYPOINTS, str(error))
        if by == MatchBy.DESCRIPTOR and len(keypoints) > MOST_KEYPOINTS:
            self._notice(
                Notice.TOO_MANY_KEYPOINTS,
                f"{len(keypoints)} keypoints have come; the best {MOST_KEYPOINTS} are matched",
            )
        return by

    def match(
        self, keypoints: Keypoints, camera: Camera, prior: Prior | None
    ) -> Correspondences | Refusal:
        """Match keypoints all over the map, or only where a motion predicts them."""
        assert self._matcher is not None
        matches = self._matcher.match(keypoints, camera, prior)
        if len(matches) == 0:
            return Refusal(
                Reason.NO_MATCHES,
                f"none of {len(keypoints)} keypoints matches one of {len(self._matcher.map)} "
                f"landmarks by {matches.by}",
            )
        from rs_localizer.matching import correspondences

        found = correspondences(matches, keypoints, self._matcher.map)
        self._last = keypoints, found
        return found

    def repeated(self, keypoints: Keypoints) -> Correspondences | None:
        """Return the last correspondences if the image is the same, bit for bit; else None."""
        if self._last is None:
            return None
        before, found = self._last
        same = all(
            np.array_equal(getattr(before, name), getattr(keypoints, name))
            for name in ("pixels", "ids", "descriptors")
        )
        return replace(found, stamp_ns=keypoints.stamp_ns) if same else None


def read_landmarks(file: str, frame: str) -> Map:
    """Read the map of a file, to match keypoints with.

    Args:
        file: its path; ``~`` is the user's home.
        frame: of its points.

    Raises:
        MapError: for a file that cannot be read or holds no such map.
    """
    from rs_localizer.io.maps.files import read_map_file  # formats that most never read

    path = Path(file).expanduser()
    try:
        landmarks = read_map_file(path, frame)
    except MapError as error:
        raise MapError(f"map_file: {error}") from error
    except OSError as error:
        raise MapError(f"map_file: {path} cannot be read: {error.strerror or error}") from error
    if landmarks.ids is None and landmarks.descriptors is None:
        raise MapError(
            f"map_file: {path}: keypoints cannot be matched with a map that has neither ids "
            "nor descriptors"
        )
    return landmarks
