"""Offline extraction: images -> a recording of keypoints, by the feature detector's code."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, IMAGE_TOPIC, KEYPOINTS_TOPIC
from rs_localizer.offline.detect import Cameras, DetectError, Options
from rs_localizer.offline.image_sources import Carried, Shot
from rs_localizer.pipeline.features import Extracted, FrameExtractor, keypoints
from rs_localizer.pipeline.refusal import Refusal


@dataclass(slots=True)
class Extraction:
    """What became of the images."""

    images: int = 0
    counts: list[int] = field(default_factory=list)  # keypoints of the images that have any
    refused: dict[str, str] = field(default_factory=dict)  # the first detail of each reason
    carried: Counter[str] = field(default_factory=Counter)  # messages of other topics
    stamps_ns: list[int] = field(default_factory=list)

    @property
    def period(self) -> float:
        """s from one image to the next, median; NaN for a single one."""
        steps = np.diff(np.array(self.stamps_ns, np.int64))
        return float(np.median(steps)) * 1e-9 if len(steps) else np.nan


def record_features(
    shots: Iterable[Shot | Carried],
    extractor: FrameExtractor,
    out: Path,
    options: Options,
    done: Callable[[], object] = lambda: None,
) -> Extraction:
    """Write the keypoints of all images that have any, each with its CameraInfo.

    Args:
        shots: the images, and what else of their recording is to be kept.
        extractor: looks for keypoints.
        out: bag directory to create.
        options: what is written.
        done: called after each image.

    Raises:
        DetectError: when no image has keypoints, or images and calibration differ in size.
    """
    told = Extraction()
    cameras = Cameras(options.scan_direction)
    with BagWriter(out, options.storage) as bag:
        for shot in shots:
            if isinstance(shot, Carried):
                told.carried[shot.topic] += 1
                bag.write(shot.topic, shot.message, shot.recorded_ns)
                continue
            told.images += 1
            if isinstance(shot.image, Refusal):
                told.refused.setdefault(shot.image.reason, shot.image.detail)
            else:
                cameras.of(shot, shot.image)
                told.stamps_ns.append(shot.image.stamp_ns)
                extracted = extractor.extract(shot.image)
                if len(extracted.features):
                    told.counts.append(len(extracted.features))
                    _write(bag, shot, extracted, options.with_images)
            done()
        if not told.counts:
            reasons = "".join(f"; {detail}" for detail in told.refused.values())
            raise DetectError(f"none of the {told.images} images has any keypoint{reasons}")
    return told


def _write(bag: BagWriter, shot: Shot, extracted: Extracted, with_images: bool) -> None:
    bag.write(CAMERA_INFO_TOPIC, shot.camera_info, shot.recorded_ns)
    bag.write(KEYPOINTS_TOPIC, keypoints(extracted, make_message), shot.recorded_ns)
    if with_images and shot.compressed is not None:
        bag.write(IMAGE_TOPIC, shot.compressed, shot.recorded_ns)
