# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Offline detection: images -> a recording of correspondences or keypoints, as the nodes do."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.io.messages import MessageError
from rs_localizer.io.recording import (
    CAMERA_INFO_TOPIC,
    CORRESPONDENCES_TOPIC,
    IMAGE_TOPIC,
    KEYPOINTS_TOPIC,
)
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Chessboard
from rs_localizer.offline.image_sources import Carried, Shot
from rs_localizer.pipeline.keypoints import FrameExtractor, keypoints
from rs_localizer.pipeline.marker_detector import FrameDetector, correspondences
from rs_localizer.pipeline.refusal import Refusal

# Fewer corners than this say nothing about how well a pose fits.
_LEAST_CORNERS = 6
# A global-shutter pose leaves at most so much (px rms) in the stillest images, in percent of all,
# unless calibration or map are wrong: a good one leaves 0.1 to 0.5. No readout takes longer than
# the time between two images: who leaves less than what moved between them may just have moved.
_MOST_STILL, _STILL_PERCENT = 1.5, 10.0


@dataclass(slots=True)
class ImageTally:
    """Counts of used and refused images."""

    images: int = 0
    refused: dict[str, str] = field(default_factory=dict)  # the first detail of each reason
    stamps_ns: list[int] = field(default_factory=list)

    @property
    def period(self) -> float:
        """s from one image to the next, median; NaN for a single one."""
        steps = np.diff(np.array(self.stamps_ns, np.int64))
        return float(np.median(steps)) * 1e-9 if len(steps) else np.nan


@dataclass(slots=True)
class Extraction(ImageTally):
    """Content of images."""

    counts: list[int] = field(default_factory=list)  # keypoints or corners, where there are any
    carried: Counter[str] = field(default_factory=Counter)  # messages of other topics
    faults: tuple[str, ...] = ()  # what speaks against map or calibration
    notes: tuple[str, ...] = ()  # what the detector says of some images
    residual: float = np.nan  # px rms, median, of the best global-shutter poses


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """Options of how images are recorded."""

    with_images: bool = False  # write these, too, as far as they are compressed
    scan_direction: str = ScanDirection.TOP_TO_BOTTOM  # of the camera
    camera: str = ""  # of a rig, whose topics these are


def record_markers(
    shots: Iterable[Shot | Carried], detector: FrameDetector, bag: BagWriter,
    options: DetectionOptions,
) -> Extraction:  # fmt: skip
    """Write the corners of all images that show any, each with its CameraInfo.

    Args:
        shots: the images, and what else of their recording is to be kept.

    Raises:
        ValueError: when no image shows anything.
    """
    found, others, faults = Extraction(), Counter[str](), Counter[str]()
    kept, still = _kept(shots, bag, found), _StillImages()
    for shot, image, camera in usable(kept, options.scan_direction, found):
        detected = detector.detect(image)
        others.update(detected.detections.unknown)
        faults.update(detected.detections.faults)
        if count := len(detected.detections.ids):
            found.counts.append(count)
            assert camera is not None
            still.add(camera, detected.detections.points, detected.detections.pixels)
            corners = correspondences(detected, make_message)
            _write(bag, shot, CORRESPONDENCES_TOPIC, corners, options)
    if not found.counts:
        of = f" of {options.camera}" if options.camera else ""
        why = detector.mistake or _nothing_seen(detector.map, found.refused, faults, others)
        raise ValueError(
            f"none of the {found.images} images{of} shows anything of the map "
            f"({_wanted(detector.map)}){why and '; '}{why}"
        )
    found.faults = tuple(filter(None, [detector.mistake or still.fault]))
    if still.residuals:
        found.residual = float(np.median(still.residuals))
    return found


class _StillImages:
    """Residuals of global-shutter poses, of which some are those of motion during the readout."""

    def __init__(self) -> None:
        self.residuals: list[float] = []  # px rms
        self._telling: list[float] = []  # those that are not of motion
        self._before: dict[tuple[float, ...], Array] = {}  # pixels of the image before, by point

    def add(self, camera: Camera, points: Array, pixels: Array) -> None:
        """Take the corners of an image."""
        now = dict(zip(map(tuple, points.tolist()), pixels, strict=True))
        before, self._before = self._before, now
        moved = [now[point] - before[point] for point in now.keys() & before.keys()]
        residual = static_residual(camera, points, pixels)
        if not np.isfinite(residual):
            return
        self.residuals.append(residual)
        if residual <= _MOST_STILL or (moved and _rms(np.array(moved)) < residual):
            self._telling.append(residual)

    @property
    def fault(self) -> str:
        """The reason why calibration or map can hardly be right; empty if they may be."""
        least = np.percentile(self._telling, _STILL_PERCENT) if self._telling else 0.0
        if least <= _MOST_STILL:
            return ""
        return (
            f"even the stillest images leave {least:.1f} px rms: the calibration can hardly be of "
            "this camera in this mode, or the map (sizes, positions) is wrong"
        )


def _rms(steps: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(steps), axis=1))))


def static_residual(camera: Camera, points: Array, pixels: Array) -> float:
    """Return the error (px rms) of the best global-shutter pose; NaN if there is none."""
    if len(points) < _LEAST_CORNERS:
        return np.nan
    rays = np.ascontiguousarray(camera.rays(pixels))
    try:
        solved, turn, shift = cv2.solvePnP(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return np.nan
    if not solved:
        return np.nan
    seen = camera.project(points @ np.asarray(cv2.Rodrigues(turn)[0]).T + np.ravel(shift))
    return _rms(seen - pixels)


def _wanted(marker_map: MarkerMap) -> str:
    families = sorted({marker.family.name for marker in marker_map.markers})
    return ", ".join([*families, *(board.name for board in marker_map.boards)])


def _nothing_seen(
    marker_map: MarkerMap, refused: Mapping[str, str], faults: Counter[str], others: Counter[str]
) -> str:
    """Describe what images show that show nothing of the map; '' if that is nothing."""
    if refused:
        return "; ".join(refused.values())
    if faults:
        return faults.most_common(1)[0][0]
    if others:
        names = ", ".join(name for name, _ in others.most_common(5))
        return f"they show {names}, which the map does not have"
    if any(isinstance(board, Chessboard) for board in marker_map.boards):
        return "are these its inner corners, and is all of it in view?"
    return ""


def _kept(shots: Iterable[Shot | Carried], bag: BagWriter, found: Extraction) -> Iterator[Shot]:
    """Yield the images, and write what else is to be kept."""
    for shot in shots:
        if isinstance(shot, Carried):
            found.carried[shot.topic] += 1
            bag.write(shot.topic, shot.message, shot.recorded_ns)
        else:
            yield shot


def usable(
    shots: Iterable[Shot | Carried], scan_direction: str, tally: ImageTally
) -> Iterator[tuple[Shot, Image, Camera | None]]:
    """Yield the usable images, each with its camera, without a readout time, if it is known.

    Args:
        tally: of all images.

    Raises:
        ValueError: when images without a calibration are of several sizes.
    """
    cameras, size = _Cameras(scan_direction), None
    for shot in shots:
        if isinstance(shot, Carried):
            continue
        tally.images += 1
        image, camera = shot.image, None
        if not isinstance(image, Refusal):
            tally.stamps_ns.append(image.stamp_ns)
            camera = None if shot.camera_info is None else cameras.camera_of(shot, image)
        if isinstance(image, Refusal) or isinstance(camera, Refusal):
            refusal = image if isinstance(image, Refusal) else camera
            assert isinstance(refusal, Refusal)
            tally.refused.setdefault(refusal.reason, refusal.detail)
        else:
            size = size or image.pixels.shape
            if camera is None and image.pixels.shape != size:
                (height, width), (other, across) = size, image.pixels.shape
                raise ValueError(
                    f"the image at {1e-9 * image.stamp_ns:.3f} s is of {across}x{other}, those "
                    f"before it are of {width}x{height}: a lens is calibrated with images of one "
                    "size"
                )
            yield shot, image, camera


class _Cameras:
    """The camera of each image, mostly the camera of the image before."""

    def __init__(self, scan_direction: str) -> None:
        self._scan_direction = scan_direction
        self._last: tuple[Calibration, Camera] | None = None

    def camera_of(self, shot: Shot, image: Image) -> Camera | Refusal:
        """Return the camera of one image, or refuse it if its size is another one.

        Raises:
            ValueError: when its camera_info cannot be used.
        """
        try:
            calibration = read_camera_info(shot.camera_info)
            if self._last is None or self._last[0] != calibration:
                self._last = calibration, calibration.camera(0.0, self._scan_direction)
        except MessageError as error:
            raise ValueError(f"the camera_info cannot be used: {error}") from error
        camera = self._last[1]
        height, width = image.pixels.shape
        if (width, height) == camera.size:
            return camera
        return Refusal(
            Reason.BAD_IMAGE,
            f"the image at {1e-9 * image.stamp_ns:.3f} s is of {width}x{height}, the calibration "
            f"is for {camera.size[0]}x{camera.size[1]}: calibrate in the mode that is used",
        )


def _write(bag: BagWriter, shot: Shot, topic: str, message: Any, options: DetectionOptions) -> None:
    """Write the points of an image, its camera, and the image itself."""
    own = f"/{options.camera}" if options.camera else ""
    bag.write(own + CAMERA_INFO_TOPIC, shot.camera_info, shot.recorded_ns)
    bag.write(own + topic, message, shot.recorded_ns)
    if options.with_images and shot.compressed is not None:
        bag.write(own + IMAGE_TOPIC, shot.compressed, shot.recorded_ns)


def record_features(
    shots: Iterable[Shot | Carried], extractor: FrameExtractor, bag: BagWriter,
    options: DetectionOptions,
) -> Extraction:  # fmt: skip
    """Write the keypoints of all images that have any, each with its CameraInfo.

    Raises:
        ValueError: when no image has keypoints.
    """
    extraction = Extraction()
    kept = _kept(shots, bag, extraction)
    for shot, image, _ in usable(kept, options.scan_direction, extraction):
        extracted = extractor.detect(image)
        if len(extracted.features):
            extraction.counts.append(len(extracted.features))
            _write(bag, shot, KEYPOINTS_TOPIC, keypoints(extracted, make_message), options)
    if not extraction.counts:
        reasons = "".join(f"; {detail}" for detail in extraction.refused.values())
        raise ValueError(f"none of the {extraction.images} images has any keypoint{reasons}")
    return extraction
