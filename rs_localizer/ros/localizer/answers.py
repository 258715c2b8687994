"""What is told of a localized frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.io.outputs import Localized


@dataclass(frozen=True, slots=True)
class Answer:
    """What the statistics keep of a frame."""

    points: int
    inliers: int
    global_shutter_inliers: int  # what a pose without motion would have explained
    residual: float  # px, root mean square of the inliers
    model_error: float  # px, root mean square of what map, lens and motion leave beside the noise
    iterations: int
    tracked: bool
    lens: float = 0.0  # px, how far the distortion that the calibration lacks moves image points


def tell(frame: Localized) -> tuple[int, Answer]:
    """The stamp of the input (ns), and what is told."""
    estimate = frame.estimate
    residuals = estimate.residuals[estimate.inliers]
    answer = Answer(
        points=len(estimate.inliers),
        inliers=len(residuals),
        global_shutter_inliers=estimate.global_shutter_inliers,
        residual=float(np.sqrt(residuals @ residuals / max(len(residuals), 1))),
        model_error=estimate.model_error,
        iterations=estimate.iterations,
        tracked=estimate.tracked,
        lens=0.0 if estimate.lens is None else estimate.lens.pixels,
    )
    return frame.input_stamp_ns, answer
