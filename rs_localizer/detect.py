"""Offline detection: images -> a recording of correspondences, by the marker detector's code."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rs_localizer.core.camera import Camera, ScanDirection
from rs_localizer.frames import Refusal
from rs_localizer.image_sources import Shot
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.messages import MessageError
from rs_localizer.lab.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC, IMAGE_TOPIC
from rs_localizer.marker_frames import Detected, FrameDetector, correspondences

# Fewer corners than this say nothing about how well a pose fits.
_LEAST_CORNERS = 6


class DetectError(ValueError):
    """Images without a use; the message says what was found."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """What became of the images."""

    images: int
    with_corners: int
    corners: float  # median of the images that show any
    refused: dict[str, str]  # why images could not be read: the first detail of each reason
    residual: float  # px rms of a global-shutter pose, median; NaN where none was possible


def record(
    shots: Iterable[Shot],
    detector: FrameDetector,
    out: Path,
    *,
    storage: str = "mcap",
    with_images: bool = False,
    done: Callable[[], object] = lambda: None,
) -> Recorded:
    """Write the corners of all images that show any, each with its CameraInfo.

    Args:
        shots: the images.
        detector: looks for markers.
        out: bag directory to create.
        storage: ``mcap`` or ``sqlite3``.
        with_images: write these images, too, as far as they are compressed.
        done: called after each image.

    Raises:
        DetectError: when no image shows anything, or images and calibration differ in size.
    """
    images = 0
    counts: list[int] = []
    residuals: list[float] = []
    refused: dict[str, str] = {}
    others: Counter[str] = Counter()
    cameras = _Cameras()
    with BagWriter(out, storage) as bag:
        for shot in shots:
            images += 1
            if isinstance(shot.image, Refusal):
                refused.setdefault(shot.image.reason, shot.image.detail)
            else:
                detected = detector.detect(shot.image)
                others.update(detected.detections.unknown)
                camera = cameras.of(shot, detected)
                if len(detected.detections.ids):
                    _write(bag, shot, detected, with_images)
                    counts.append(len(detected.detections.ids))
                    residuals.append(static_residual(camera, detected))
            done()
    if not counts:
        if out.exists():
            shutil.rmtree(out)
        raise DetectError(_nothing(images, refused, others))
    known = [value for value in residuals if np.isfinite(value)]
    return Recorded(
        images,
        len(counts),
        float(np.median(counts)),
        refused,
        float(np.median(known)) if known else np.nan,
    )


class _Cameras:
    """The camera of each image; mostly that of the one before."""

    def __init__(self) -> None:
        self._last: tuple[Calibration, Camera] | None = None

    def of(self, shot: Shot, detected: Detected) -> Camera:
        try:
            calibration = read_camera_info(shot.camera_info)
            if self._last is None or self._last[0] != calibration:
                self._last = calibration, calibration.camera(0.0, ScanDirection.TOP_TO_BOTTOM)
        except MessageError as error:
            raise DetectError(f"the camera_info cannot be used: {error}") from error
        camera = self._last[1]
        height, width = detected.image.pixels.shape
        if (width, height) != camera.size:
            raise DetectError(
                f"the images are of {width}x{height}, the calibration is for "
                f"{camera.size[0]}x{camera.size[1]}"
            )
        return camera


def _write(bag: BagWriter, shot: Shot, detected: Detected, with_images: bool) -> None:
    stamp_ns = detected.image.stamp_ns
    bag.write(CAMERA_INFO_TOPIC, shot.camera_info, stamp_ns)
    bag.write(CORRESPONDENCES_TOPIC, correspondences(detected, make_message), stamp_ns)
    if with_images and shot.compressed is not None:
        bag.write(IMAGE_TOPIC, shot.compressed, stamp_ns)


def _nothing(images: int, refused: dict[str, str], others: Counter[str]) -> str:
    text = f"none of the {images} images shows anything of the map"
    if refused:
        text += f"; {'; '.join(refused.values())}"
    if others:
        names = ", ".join(name for name, _ in others.most_common(5))
        text += f"; they show {names}, which the map does not have"
    return text


def static_residual(camera: Camera, detected: Detected) -> float:
    """Reprojection error (px rms) of the best global-shutter pose; NaN: there is none."""
    found = detected.detections
    if len(found.ids) < _LEAST_CORNERS:
        return np.nan
    rays = np.ascontiguousarray(camera.rays(found.pixels))
    try:
        solved, rotation, translation = cv2.solvePnP(
            found.points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return np.nan
    if not solved:
        return np.nan
    local = found.points @ cv2.Rodrigues(rotation)[0].T + translation.T
    errors = camera.project(local) - found.pixels
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
