"""Pictures of a comparison, of its frames as a whole and of a single one."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from matplotlib.figure import Figure

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.evaluation import plots
from rs_localizer.evaluation.comparison import (
    Recording,
    Result,
    counts_at,
    predicted_pixels,
    true_rates,
)
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.trajectories import Trajectory

_RESIDUAL_TITLE = "The frame where they differ most"


def trajectory_picture(recording: Recording, results: Mapping[str, Result]) -> Figure:
    """Positions of all methods over the truth."""
    return plots.trajectories(
        _truth_during(recording), {name: result.poses for name, result in results.items()}
    )


def error_picture(results: Mapping[str, Result]) -> Figure:
    """Errors over time; the recording has to hold the truth."""
    errors = {name: r.errors for name, r in results.items() if r.errors is not None}
    return plots.errors(errors, {})


def inlier_picture(
    recording: Recording, results: Mapping[str, Result], true_matches: Array
) -> Figure:
    """Inliers of each frame, ``true_matches`` (n,) of which there are, and the angular rate."""
    counts = {name: counts_at(result, recording.stamps_ns) for name, result in results.items()}
    return plots.inliers(
        np.array(recording.stamps_ns), counts, true_matches, true_rates(recording), "true matches"
    )


def residual_picture(
    recording: Recording, results: Mapping[str, Result], readout_time: float
) -> Figure | None:
    """Residuals of the frame in which the methods differ most, on its image.

    Returns:
        None when no frame with an image was localized by all methods.
    """
    best: tuple[float, Figure] | None = None
    for stamp, info, cloud in zip(
        recording.stamps_ns, recording.camera_infos, recording.clouds, strict=True
    ):
        if stamp not in recording.images or any(stamp not in r.answers for r in results.values()):
            continue
        camera = _camera(info, readout_time)
        seen = read_correspondences(cloud)
        predicted = {
            name: predicted_pixels(camera, result.answers[stamp], seen.points)
            for name, result in results.items()
        }
        worst, *others = sorted((_rms(p - seen.pixels) for p in predicted.values()), reverse=True)
        difference = worst - min(others, default=0.0)
        if best is None or difference > best[0]:
            data = np.frombuffer(recording.images[stamp].data, np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            best = (
                difference,
                plots.residuals(
                    np.asarray(image, np.uint8), seen.pixels, predicted, _RESIDUAL_TITLE
                ),
            )
    return None if best is None else best[1]


def _truth_during(recording: Recording) -> Trajectory | None:
    if recording.truth is None:
        return None
    poses = recording.truth.poses
    first, last = recording.stamps_ns[0], recording.stamps_ns[-1]
    return poses.part((poses.stamps_ns >= first) & (poses.stamps_ns <= last))


def _camera(info: object, readout_time: float) -> Camera:
    return read_camera_info(info).camera(readout_time, ScanDirection.TOP_TO_BOTTOM)


def _rms(offsets: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))
