# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks with descriptors, and keypoints as detectors make them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.io.maps.landmarks import Descriptors, Map
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame

# Share of the bits that differ between two views of a landmark; ORB's median is about this.
BIT_ERRORS = 0.1
# Noise of each number of a descriptor whose numbers have the deviation 1.
DEVIATION = 0.3


def random_descriptors(count: int, rng: np.random.Generator, width: int = 32) -> NDArray[np.uint8]:
    """Return the binary descriptors (count,width) without anything in common."""
    return rng.integers(0, 256, (count, width), dtype=np.uint8)


def seen_descriptors(descriptors: Descriptors, rng: np.random.Generator) -> Descriptors:
    """Return the descriptors (n,width) as another image has them."""
    count, width = descriptors.shape
    if descriptors.dtype == np.uint8:
        flips: NDArray[np.uint8] = np.packbits(rng.random((count, 8 * width)) < BIT_ERRORS, axis=1)
        return descriptors.astype(np.uint8) ^ flips
    return (descriptors + rng.normal(0.0, DEVIATION, (count, width))).astype(np.float32)


def keypoint_rows(frame: SimulatedFrame, landmarks: Map, rng: np.random.Generator) -> NDArray[Any]:
    """Return rows (n,) of a cloud of keypoints: pixels, and ids or descriptors of landmarks.

    Outliers of the frame have the mark of a landmark and the pixel of something else, as wrong
    matches do.
    """
    kinds: list[tuple[Any, ...]] = [("u", "<f4"), ("v", "<f4")]
    if landmarks.ids is not None:
        kinds.append(("id", landmarks.id_type))
    if landmarks.descriptors is not None:
        descriptors = landmarks.descriptors
        kinds.append(("descriptor", descriptors.dtype, descriptors.shape[1:]))
    rows = np.empty(len(frame.ids), kinds)
    rows["u"], rows["v"] = frame.pixels.T
    if landmarks.ids is not None:
        rows["id"] = landmarks.ids[frame.ids]
    if landmarks.descriptors is not None:
        rows["descriptor"] = seen_descriptors(landmarks.descriptors[frame.ids], rng)
    return rows
