# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames that do not fit for a mistake of their sender in pixels.

Each known mistake is undone on the points of the frame. If the frame fits then, the mistake is
found; residuals alone do not show it. Some such frames have a pose: of a mirrored room, one wall
fits as it is seen from behind.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.io.outputs import Localized
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.refusal import Notify, Refusal, unheard

REASONS = frozenset({
    Reason.TOO_FEW_POINTS, Reason.NO_HYPOTHESIS, Reason.TOO_FEW_INLIERS, Reason.BEHIND_CAMERA,
    Reason.RESIDUAL, Reason.MODEL_ERROR, Reason.CALIBRATION,
})  # fmt: skip
"""Reasons of refusals that such a mistake may have."""

# Least share of inliers: a fault that all points share leaves only the outliers of any frame.
_MOST = 0.7
# A pose that explains less than this share of the points is in doubt, too.
_HALF = 0.5
# Single frames are refused for many reasons: one in a growing number of times more is tried, so
# that a day of refusals costs some ten tries.
_RARER = 4
# Frames that say the same: one may fit by chance.
_AGREED = 2
# Points are flat if they lie within this share of their extent.
_FLAT = 0.02


_MIRRORED = (
    "pixels are mirrored, left to right or top to bottom: the sender mirrors them (or the map is "
    "left-handed)"
)
# Sentences, and axes of the image that undo what they say. The two mirrors differ by a half turn
# of the camera and the direction of the shutter, which one image hardly shows. Of a plane none
# shows: mirrored, it is seen from behind.
_MISTAKES = [
    (_MIRRORED, np.array([[-1.0, 0.0], [0.0, 1.0]])),
    (_MIRRORED, np.array([[1.0, 0.0], [0.0, -1.0]])),
    ("u and v are exchanged: u counts columns, v rows", np.array([[0.0, 1.0], [1.0, 0.0]])),
]


def what_fits(localizer: Localizer, points: Array, pixels: Array) -> str:
    """Say in a sentence what is wrong with a refused frame; an empty text if nothing is found.

    Args:
        localizer: of a camera alone, that refused it.
        points, pixels: (n,3) and (n,2), as they came.
    """
    fits: dict[tuple[int, float], str] = {}
    last = np.array(localizer.camera.size) - 1.0
    for mistake, turn in [] if _is_flat(points) else _MISTAKES:
        found = localizer.localize(points, pixels @ turn + last * (turn.sum(axis=0) < 0.0))
        # Before a wrong lens anything fits, with smooth errors beyond the gate.
        if not found or found.model_error > localizer.config.inlier_threshold:
            continue
        if (count := int(np.count_nonzero(found.inliers))) >= _MOST * len(points):
            fits[count, -found.residual_rms] = mistake
    return f"the points fit if {fits[max(fits)]}" if fits else ""


def _is_flat(points: Array) -> bool:
    """Return whether points lie in a plane: a mirrored plane is seen from behind, and fits."""
    if len(points) < 4:
        return True
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[2] < _FLAT * extents[0])


def cameras_apart(
    localizer: Localizer, matches: Mapping[str, Sequence[Array]], stamps: Mapping[str, float]
) -> str:
    """Say that cameras of a refused rig have poses of their own; an empty text if they have none.

    Args:
        localizer: of the rig.
        matches, stamps: of each camera, as of :meth:`.Localizer.localize`.
    """
    alone = {
        name: localizer.localize({name: of}, stamps={name: stamps[name]})
        for name, of in matches.items()
    }
    own = [name for name, found in alone.items() if found]
    if len(own) < 2:
        return ""
    return (
        f"{' and '.join(own)} have poses of their own that disagree: extrinsics or clocks "
        "are wrong (rs_localizer calibrate --rig)"
    )


class Mistakes:
    """Looks for a mistake in refused frames, now and then.

    Args:
        notice: told what was found.
    """

    def __init__(self, notice: Notify = unheard) -> None:
        self._notice = notice
        self._refused, self._next = 0, 1
        self._agreed, self._said = 0, ""

    def explain_frame(self, tried: Callable[[], str]) -> str:
        """Say what is wrong with one more frame; an empty text if nothing is found.

        Args:
            tried: names what fits, as :func:`what_fits`; called now and then.
        """
        self._refused += 1
        if self._agreed < _AGREED and self._refused >= self._next:
            said = tried()
            self._agreed = self._agreed * (said == self._said) + 1 if said else 0
            self._next = self._refused + 1 if said else _RARER * self._refused
            self._said = said
        return self._said if self._agreed >= _AGREED else ""

    def explained(
        self, result: Localized | Refusal, tried: Callable[[], str],
        notice: Notice = Notice.WOULD_FIT,
    ) -> Localized | Refusal:  # fmt: skip
        """Return what became of a frame, with what would fit if something was found.

        A pose that explains less than half of the points is refused for what fits them.
        """
        if result and np.mean(result.estimate.inliers) >= _HALF:
            self._agreed = 0
            return result
        said = self.explain_frame(tried) if result or result.reason in REASONS else ""
        if not said:
            return result
        self._notice(notice, said)
        if result:
            return Refusal(Reason.CALIBRATION, said)
        return replace(result, detail=f"{result.detail}; {said}")
