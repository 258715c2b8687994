# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images with their correspondences, one pose each, as an adjustment takes them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from rs_localizer.config import CalibrationErrors
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.clouds import Correspondences
from rs_localizer.localizer import Localizer
from rs_localizer.tools.adjust.variables import SplineKeypoints

# What a wrong lens looks like in one image, and how much larger errors may be there.
_OF_THE_LENS = (Reason.MODEL_ERROR, Reason.RESIDUAL, Reason.CALIBRATION)
_ROUGH = 5.0
# Of a lens that is a guess.
_ANY_LENS = CalibrationErrors(focal_length=0.3, distortion=20.0)


@dataclass(frozen=True, slots=True, eq=False)
class ImagePoints:
    """Keypoints of one image, and the map's points that they show."""

    stamp_ns: int
    points: Array  # (n,3) m, map frame
    pixels: Array  # (n,2) raw


Image = TypeVar("Image", ImagePoints, Correspondences)


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """All keypoints of a recording, and a first pose of each image that has one."""

    observations: SplineKeypoints
    start_ns: int  # time 0 of all seconds
    times: Array  # (f,) s, of the images with a pose
    rotations: Array  # (f,3,3) map_from_camera
    positions: Array  # (f,3) m


def in_order(images: Iterable[Image]) -> list[Image]:
    """Return images that show something by their stamps, one for each."""
    once = {image.stamp_ns: image for image in images if len(image.points)}
    return [once[stamp] for stamp in sorted(once)]


def localize_each(
    camera: Camera, images: Sequence[ImagePoints | Correspondences]
) -> list[Estimate | Failure]:
    """Localize each image on its own, with a bar: the readout time need not be known.

    Nor need the lens be right: where it is too wrong for a pose to be published, a rough one is a
    start for an estimator that finds the lens as well.
    """
    localizer = Localizer(camera)
    gate = _ROUGH * localizer.config.inlier_threshold
    rough = Localizer(camera, inlier_threshold=gate, calibration=_ANY_LENS)
    results = []
    for image in tqdm(images, "localize", unit="image", disable=None):
        sights = localizer.sights(image.points, image.pixels)
        result = localizer.find(sights)
        if isinstance(result, Failure) and result.reason in _OF_THE_LENS:
            result = rough.find(sights)
        results.append(result)
    return results


def collect(
    camera: Camera, images: list[ImagePoints], results: list[Estimate | Failure], delay: float = 0.0
) -> Posed:
    """Return keypoints and poses of images in the order of their stamps.

    Args:
        delay: s from the stamp to the middle row's exposure; while the readout time is unknown it
            may be anything, since the motion is only shifted by it.
    """
    start_ns = images[0].stamp_ns
    times = np.array([(image.stamp_ns - start_ns) * 1e-9 for image in images]) + delay
    counts = [len(image.points) for image in images]
    pixels = np.concatenate([image.pixels for image in images])
    points = np.concatenate([image.points for image in images])
    landmarks, rows = np.unique(points, axis=0, return_inverse=True)
    trusted = [
        result.inliers if result else np.zeros(count, dtype=np.bool_)
        for result, count in zip(results, counts, strict=True)
    ]
    posed = np.flatnonzero([bool(result) for result in results])
    estimates = [result for result in results if isinstance(result, Estimate)]
    observations = SplineKeypoints(
        camera, np.repeat(times, counts), camera.row_time(pixels), pixels, landmarks, rows.ravel(),
        frames=np.repeat(np.arange(len(images)), counts), trusted=np.concatenate(trusted),
    )  # fmt: skip
    return Posed(
        observations, start_ns, times[posed],
        np.array([estimate.rotation.T for estimate in estimates]).reshape(-1, 3, 3),
        np.array([estimate.position for estimate in estimates]).reshape(-1, 3),
    )  # fmt: skip
