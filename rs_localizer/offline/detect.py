# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Offline detection: images -> a recording of correspondences or keypoints, as the nodes do."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
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
from rs_localizer.markers.prints import Chessboard
from rs_localizer.offline.image_sources import Carried, Shot
from rs_localizer.pipeline.keypoints import FrameExtractor, keypoints
from rs_localizer.pipeline.marker_detector import Detected, FrameDetector, correspondences
from rs_localizer.pipeline.refusal import Refusal

# Fewer corners than this say nothing about how well a pose fits.
_LEAST_CORNERS = 6
# Fewer than this share of the images with anything of the map are a reason to tell.
_FEW = 0.3
# After this many images without the map, a few seconds of a video, chance is excluded.
_PATIENCE = 64
# A global-shutter pose leaves at most so much (px rms) in the stillest images, in percent of all,
# unless calibration or map are wrong: a good one leaves 0.1 to 0.5. No readout takes longer than
# the time between two images: who leaves less than what moved between them may just have moved.
_MOST_STILL, _STILL_PERCENT = 1.5, 10.0
# If none fits, this many images of another size than the calibration's are no stray ones.
_MISFITS = 3


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
    residual: float = np.nan  # px rms of a global-shutter pose, median; NaN where none was possible
    faults: tuple[str, ...] = ()  # what speaks against map or calibration
    notes: tuple[str, ...] = ()  # what the detector says of some images


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """Options of how images are recorded."""

    with_images: bool = False  # write these, too, as far as they are compressed
    scan_direction: str = ScanDirection.TOP_TO_BOTTOM  # of the camera
    camera: str = ""  # of a rig, whose topics these are


def record_markers(
    shots: Iterable[Shot | Carried], detector: FrameDetector, bag: BagWriter,
    options: DetectionOptions, *, done: Callable[[], object] = lambda: None,
    tell: Callable[[str], object] = lambda text: None,
) -> Extraction:  # fmt: skip
    """Write the corners of all images that show any, each with its CameraInfo.

    Args:
        shots: the images, and what else of their recording is to be kept.
        done: called after each image.
        tell: called if many images at the beginning show nothing, with what they show instead.

    Raises:
        ValueError: when no image shows anything, or images and calibration differ in size.
    """
    found = Extraction()
    tally = _MarkerTally(detector, found)
    for shot, image, camera in usable(
        _kept(shots, bag, found), options.scan_direction, found, done
    ):
        assert camera is not None
        detected = detector.detect(image)
        tally.add(camera, detected)
        if len(detected.detections.ids):
            corners = correspondences(detected, make_message)
            _write(bag, shot, CORRESPONDENCES_TOPIC, corners, options)
        # So few may show another board in part.
        if found.images == _PATIENCE and len(found.counts) < _FEW * found.images:
            count = len(found.counts) or "none"
            tell(f"{count} of the first {_PATIENCE} images {tally.nothing()}")
    if not found.counts:
        of = f" of {options.camera}" if options.camera else ""
        raise ValueError(f"none of the {found.images} images{of} {tally.nothing()}")
    return tally.recorded()


def _kept(shots: Iterable[Shot | Carried], bag: BagWriter, found: Extraction) -> Iterator[Shot]:
    """Yield the images, and write what else is to be kept."""
    for shot in shots:
        if isinstance(shot, Carried):
            found.carried[shot.topic] += 1
            bag.write(shot.topic, shot.message, shot.recorded_ns)
        else:
            yield shot


def usable(
    shots: Iterable[Shot | Carried], scan_direction: str, tally: ImageTally,
    done: Callable[[], object] = lambda: None,
) -> Iterator[tuple[Shot, Image, Camera | None]]:  # fmt: skip
    """Yield the usable images, each with its camera, without a readout time, if it is known.

    Args:
        tally: of all images.
        done: called after each of them.

    Raises:
        ValueError: when they and their calibration differ in size, or, without one, they are of
            several sizes.
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
        done()


class _MarkerTally:
    """Counts the parts of a map that images show."""

    def __init__(self, detector: FrameDetector, found: Extraction) -> None:
        marker_map = detector.map
        self._detector, self._map, self._found = detector, marker_map, found
        self._others: Counter[str] = Counter()
        self._faults: Counter[str] = Counter()
        self._residuals: list[float] = []
        self._telling: list[float] = []  # those that are not of motion during the readout
        self._before: dict[tuple[float, ...], Array] = {}  # pixels of the image before, by point

    def add(self, camera: Camera, detected: Detected) -> None:
        detections = detected.detections
        self._others.update(detections.unknown)
        self._faults.update(detections.faults)
        if len(detections.ids):
            self._found.counts.append(len(detections.ids))
            residual = static_residual(camera, detected)
            self._residuals.append(residual)
            moved = self._moved(detected)
            if residual <= _MOST_STILL or moved < residual:
                self._telling.append(residual)

    def _moved(self, detected: Detected) -> float:
        """Return the motion (px rms) since the image before; infinite where it is unknown."""
        points, pixels = detected.detections.points, detected.detections.pixels
        now = dict(zip(map(tuple, points.tolist()), pixels, strict=True))
        before, self._before = self._before, now
        moved = [now[point] - before[point] for point in now.keys() & before.keys()]
        return float(np.sqrt(np.mean(np.sum(np.square(moved), axis=1)))) if moved else np.inf

    def nothing(self) -> str:
        """Describe images that show nothing of the map."""
        families = sorted({marker.family.name for marker in self._map.markers})
        wanted = ", ".join([*families, *(board.name for board in self._map.boards)])
        text = f"shows anything of the map ({wanted})"
        if self._detector.mistake:
            return f"{text}; {self._detector.mistake}"
        if self._found.refused:
            text += f"; {'; '.join(self._found.refused.values())}"
        if self._faults:
            return f"{text}; {self._faults.most_common(1)[0][0]}"
        if self._others:
            names = ", ".join(name for name, _ in self._others.most_common(5))
            return f"{text}; they show {names}, which the map does not have"
        if any(isinstance(board, Chessboard) for board in self._map.boards):
            return f"{text}; are these its inner corners, and is all of it in view?"
        return text

    def recorded(self) -> Extraction:
        known = [value for value in self._residuals if np.isfinite(value)]
        faults = list[str]()
        if mistake := self._detector.mistake:
            faults.append(mistake)
        elif (telling := self._telling) and (
            least := float(np.percentile(telling, _STILL_PERCENT))
        ) > _MOST_STILL:
            faults.append(
                f"even the stillest images leave {least:.1f} px rms: the calibration can hardly be "
                "of this camera in this mode, or the map (sizes, positions) is wrong"
            )
        self._found.faults = tuple(faults)
        if known:
            self._found.residual = float(np.median(known))
        return self._found


class _Cameras:
    """The camera of each image, mostly the camera of the image before."""

    def __init__(self, scan_direction: str) -> None:
        self._scan_direction = scan_direction
        self._last: tuple[Calibration, Camera] | None = None
        self._fits, self._misfits = False, 0  # whether an image has the calibration's size; others

    def camera_of(self, shot: Shot, image: Image) -> Camera | Refusal:
        """Return the camera of one image, or refuse it if its size is another one.

        Raises:
            ValueError: when its camera_info cannot be used, or the first images are of another
                size.
        """
        try:
            calibration = read_camera_info(shot.camera_info)
            if self._last is None or self._last[0] != calibration:
                self._last = calibration, calibration.camera(0.0, self._scan_direction)
        except MessageError as error:
            raise ValueError(f"the camera_info cannot be used: {error}") from error
        camera = self._last[1]
        (height, width), (across, down) = image.pixels.shape, camera.size
        sizes = f"of {width}x{height}, the calibration is for {across}x{down}"
        if (width, height) == camera.size:
            self._fits = True
            return camera
        self._misfits += 1
        if self._misfits >= _MISFITS and not self._fits:
            raise ValueError(f"the images are {sizes}{_why((width, height), camera.size)}")
        text = f"the image at {1e-9 * image.stamp_ns:.3f} s is {sizes}"
        return Refusal(Reason.BAD_IMAGE, text)


def _why(size: tuple[int, int], calibrated: tuple[int, int]) -> str:
    """Describe the relation of two sizes of images."""
    if size == calibrated[::-1]:
        return (
            ": they are rotated by a quarter turn; calibrate with images as they are recorded (the "
            "scan direction rotates with them)"
        )
    if abs(size[0] * calibrated[1] - size[1] * calibrated[0]) <= max(calibrated):
        return ": another resolution of the same shape; calibrate in the mode that is used"
    return ": another mode or camera; calibrate in the mode that is used"


def _write(bag: BagWriter, shot: Shot, topic: str, message: Any, options: DetectionOptions) -> None:
    """Write the points of an image, its camera, and the image itself."""
    own = f"/{options.camera}" if options.camera else ""
    bag.write(own + CAMERA_INFO_TOPIC, shot.camera_info, shot.recorded_ns)
    bag.write(own + topic, message, shot.recorded_ns)
    if options.with_images and shot.compressed is not None:
        bag.write(own + IMAGE_TOPIC, shot.compressed, shot.recorded_ns)


def static_residual(camera: Camera, detected: Detected) -> float:
    """Return the error (px rms) of the best global-shutter pose; NaN if there is none."""
    detections = detected.detections
    if len(detections.ids) < _LEAST_CORNERS:
        return np.nan
    points, rays = detections.points, np.ascontiguousarray(camera.rays(detections.pixels))
    try:
        solved, turn, shift = cv2.solvePnP(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return np.nan
    if not solved:
        return np.nan
    seen = camera.project(points @ np.asarray(cv2.Rodrigues(turn)[0]).T + np.ravel(shift))
    return float(np.sqrt(np.mean(np.sum((seen - detections.pixels) ** 2, axis=1))))


def record_features(
    shots: Iterable[Shot | Carried], extractor: FrameExtractor, bag: BagWriter,
    options: DetectionOptions, done: Callable[[], object] = lambda: None,
) -> Extraction:  # fmt: skip
    """Write the keypoints of all images that have any, each with its CameraInfo.

    Raises:
        ValueError: when no image has keypoints, or images and calibration differ in size.
    """
    extraction = Extraction()
    kept = _kept(shots, bag, extraction)
    for shot, image, _ in usable(kept, options.scan_direction, extraction, done):
        extracted = extractor.detect(image)
        if len(extracted.features):
            extraction.counts.append(len(extracted.features))
            _write(bag, shot, KEYPOINTS_TOPIC, keypoints(extracted, make_message), options)
    if not extraction.counts:
        reasons = "".join(f"; {detail}" for detail in extraction.refused.values())
        raise ValueError(f"none of the {extraction.images} images has any keypoint{reasons}")
    return extraction
