# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether frames contradict what is said of lens and map: given deviations are promises.

What one frame leaves may be chance, what all of them leave is not. A lens that belongs to another
image before one wall is seen in some frames only: where the camera looks at it aslant.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from rs_localizer.core.reasons import Reason
from rs_localizer.core.types import Estimate, Failure

# Frames of which the median counts.
_FRAMES = 15
# Smooth errors are as large as they are declared to be to a factor of e; in so many of them.
_BEYOND = 4.5
# Of the distortion's deviation at the corners: what it leaves on average where motion takes up
# nothing. Of an ordinary one 0.3 px; surveyed tags before a calibrated lens have 0.2.
_OF_DISTORTION = 0.6
# So many of so many frames that another camera matrix explains are no chance: of twelve real boards
# none has one.
_OTHERS, _OF_THE_LAST = 3, 30


class LensWatch:
    """Compares smooth errors with what is declared; see the module.

    Args:
        distortion: its deviation, px at the corners.
    """

    def __init__(self, distortion: float) -> None:
        self._least = _OF_DISTORTION * distortion
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.fault = ""
        """How the last frames contradict what is declared, in one sentence."""
        self._sizes: deque[tuple[float, float]] = deque(maxlen=_FRAMES)
        self._others: deque[str] = deque(maxlen=_OF_THE_LAST)

    @property
    def refusal(self) -> str:
        """Why no pose can be told: K is that of another image."""
        others = [text for text in self._others if text]
        return others[-1] if len(others) >= _OTHERS else ""

    def add(self, found: Estimate | Failure) -> None:
        """Take a frame of a camera alone, as it was localized."""
        if not found:
            self._others.append(found.detail if found.reason is Reason.CALIBRATION else "")
            return
        self._others.append("")
        if len(found.shake):  # vibration moves points smoothly, too
            return
        self._sizes.append((found.model_error, found.declared_error))
        if len(self._sizes) < _FRAMES:
            return
        off, declared = np.median(self._sizes, axis=0)
        allowed = self._allowed(declared)
        self.fault = (
            f"residuals vary smoothly over the image ({off:.2g} px rms), more than the deviations "
            f"of calibration and map allow ({allowed:.2g} px): is the image of another mode or "
            "resolution, rectified or stabilized, or of another camera, or is the map off? "
            "Calibrate in the mode that is used, or set map_deviation"
            if off > allowed
            else ""
        )

    def is_beyond(self, found: Estimate) -> bool:
        """Return whether one frame's smooth error is beyond what is declared."""
        return found.model_error > self._allowed(found.declared_error)

    def _allowed(self, declared: float) -> float:
        """Return the largest smooth error (px, rms) that deviations allow."""
        return max(_BEYOND * declared, self._least)
