# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Queries of hloc -> poses and velocities, of the matches that hloc has found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.hloc import H5File, HlocError
from rs_localizer.io.maps.colmap import read_images, read_model
from rs_localizer.localizer import Localizer

NO_PAIRS = "no image of the model is paired with it"


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What became of a query."""

    name: str
    matches: int  # with points of the model
    result: Estimate | Failure | str  # the latter: why there is nothing to localize


class Reference:
    """A sparse model of COLMAP: which keypoint of which image shows which point.

    Raises:
        MapError: for anything that is not a model, OSError as any file.
    """

    def __init__(self, folder: Path) -> None:
        self.images = read_images(folder)
        model = read_model(folder)
        self.points = model.points
        owners = np.repeat(np.arange(len(model.points)), np.diff(model.starts))
        order = np.argsort(model.tracks["image"], kind="stable")
        numbers, starts = np.unique(model.tracks["image"][order], return_index=True)
        ends = [*starts[1:].tolist(), len(order)]
        self._rows = {
            number: order[start:end]
            for number, start, end in zip(numbers.tolist(), starts.tolist(), ends, strict=True)
        }
        self._features, self._owners = model.tracks["feature"].astype(np.int64), owners

    def points_of(self, image: str, keypoints: IntArray) -> IntArray:
        """The points (m,) that these keypoints (m,) of an image show; -1: none.

        Raises:
            HlocError: when the image has fewer keypoints.
        """
        known = self.images[image]
        count = len(known.pixels)
        if count and keypoints.max(initial=-1) >= count:
            raise HlocError(
                f"the matches are of keypoint {keypoints.max()} of {image}, which has "
                f"{count} in the model: are model and matches of one run?"
            )
        rows = self._rows.get(known.number)
        if rows is None or not len(keypoints):
            return np.full(len(keypoints), -1)
        features = self._features[rows]
        shown = np.full(max(int(features.max()), int(keypoints.max())) + 1, -1)
        shown[features] = self._owners[rows]
        return shown[keypoints]


def localize_queries(
    reference: Reference,
    queries: Mapping[str, Camera],
    pairs: Mapping[str, list[str]],
    features: H5File,
    matches: H5File,
    config: NodeConfig,
) -> Iterator[Answer]:
    """Localize each query by its matches with the images that are paired with it.

    Args:
        reference: the model.
        queries: cameras of the images, without their shutter.
        pairs: images of the model by query.
        features: keypoints of the queries.
        matches: of queries and images.
        config: how; readout_time and scan_direction are those of all queries.

    Raises:
        HlocError: when pairs and files do not belong together.
    """
    localizers: dict[int, Localizer] = {}  # by their cameras, which many queries share
    for name, camera in queries.items():
        images = [image for image in pairs.get(name, []) if image in reference.images]
        if not images:
            yield Answer(name, 0, NO_PAIRS)
            continue
        if id(camera) not in localizers:
            localizers[id(camera)] = Localizer(
                replace(
                    camera,
                    readout_time=config.readout_time,
                    scan_direction=config.scan_direction,
                ),
                config,
            )
        pixels = features.keypoints(name)
        keypoints, points, votes = _matched(reference, name, images, matches, len(pixels))
        finite = np.isfinite(pixels[keypoints]).all(axis=1)
        keypoints, points, votes = keypoints[finite], points[finite], votes[finite]
        result = localizers[id(camera)].localize(reference.points[points], pixels[keypoints], votes)
        yield Answer(name, len(points), result)


def _matched(
    reference: Reference, query: str, images: list[str], matches: H5File, count: int
) -> tuple[IntArray, IntArray, Array]:
    """Keypoints (m,), points (m,), and how many images say so (m,); each pair once."""
    found = [np.zeros((0, 2), np.int64)]
    for image in images:
        pairs = matches.matches(query, image)
        if pairs.min(initial=0) < 0:
            raise HlocError(
                f"the matches of {query} and {image} are of keypoint {pairs.min()}: is the file "
                "damaged?"
            )
        if pairs[:, 0].max(initial=-1) >= count:
            raise HlocError(
                f"the matches of {query} and {image} are of keypoint {pairs[:, 0].max()}, but "
                f"{query} has {count}: are features and matches of one run?"
            )
        points = reference.points_of(image, pairs[:, 1])
        known = points >= 0
        found.append(np.column_stack([pairs[known, 0], points[known]]))
    unique, votes = np.unique(np.concatenate(found), axis=0, return_counts=True)
    return unique[:, 0], unique[:, 1], votes.astype(np.float64)
