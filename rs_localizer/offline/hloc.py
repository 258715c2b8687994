# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Queries of hloc (Hierarchical-Localization) -> poses and velocities, and hloc's files.

hloc keeps keypoints with the centre of the first pixel at 0, 0, as this project does, and adds
COLMAP's half pixel itself. The cameras of its list of queries are COLMAP's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.calibration import colmap_camera
from rs_localizer.io.maps.colmap import read_model
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
        model = read_model(folder)
        self.images, self.points, self._ids = model.images, model.points, model.ids

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
        shown = np.full(len(keypoints), -1) if not count else known.points[keypoints]
        rows = np.searchsorted(self._ids, shown)  # they rise
        there = np.isin(shown, self._ids)
        return np.where(there, rows, -1)


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
                    camera, readout_time=config.readout_time, scan_direction=config.scan_direction
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
    matched = [np.zeros((0, 2), np.int64)]
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
        matched.append(np.column_stack([pairs[known, 0], points[known]]))
    unique, votes = np.unique(np.concatenate(matched), axis=0, return_counts=True)
    return unique[:, 0], unique[:, 1], votes.astype(np.float64)


_KEYPOINTS, _MATCHES = "keypoints", "matches0"
# Between the names of a pair: now, in a group of the first one, and in older files.
_SEPARATORS = ("/", "_")
# What h5py raises of a damaged file, for that of an absurd size.
_DAMAGES = (
    *(KeyError, TypeError, ValueError, OSError, AttributeError, RuntimeError),
    *(MemoryError, OverflowError, IndexError),
)
_NONE = -1  # of a keypoint without a match


class HlocError(ValueError):
    """A file of hloc that cannot be used; the text names it and says what was found."""


def read_queries(path: Path) -> dict[str, Camera]:
    """The cameras of ``name MODEL width height parameters...``, by the names of the images.

    Raises:
        HlocError: for a line that is something else, or a camera that is not supported.
    """
    cameras: dict[str, Camera] = {}
    same: dict[str, Camera] = {}  # many images are of one camera
    for number, line in _lines(path):
        name, _, camera = line.partition(" ")
        try:
            if camera not in same:
                same[camera] = colmap_camera(f"1 {camera.strip()}", None)
        except ValueError as error:
            raise HlocError(
                f"{path}, line {number}: expected NAME MODEL WIDTH HEIGHT PARAMETERS, found "
                f"{line[:80]!r}: {error}"
            ) from error
        cameras[name] = same[camera]
    if not cameras:
        raise HlocError(f"{path} has no query")
    return cameras


def read_pairs(path: Path) -> dict[str, list[str]]:
    """The images of the model that are like a query, ``query image`` a line.

    Raises:
        HlocError: for a line that is something else.
    """
    pairs: dict[str, list[str]] = {}
    for number, line in _lines(path):
        words = line.split()
        if len(words) != 2:
            raise HlocError(f"{path}, line {number}: expected QUERY IMAGE, found {line[:80]!r}")
        pairs.setdefault(words[0], []).append(words[1])
    if not pairs:
        raise HlocError(f"{path} has no pair")
    return pairs


class H5File:
    """An open HDF5 file of features or of matches."""

    def __init__(self, path: Path, file: Any) -> None:
        self._path = path
        self._file = file

    def keypoints(self, name: str) -> Array:
        """Raw pixels (n,2) of an image.

        Raises:
            HlocError: when it has none.
        """
        try:
            values = np.asarray(self._file[name][_KEYPOINTS][()], np.float64)
        except _DAMAGES:
            raise HlocError(f"{self._path} has no {_KEYPOINTS} of {name}") from None
        if values.ndim != 2 or values.shape[1] < 2:
            raise HlocError(
                f"{self._path}: the {_KEYPOINTS} of {name} must be (n,2), found {values.shape}"
            )
        return np.ascontiguousarray(values[:, :2])

    def matches(self, one: str, other: str) -> IntArray:
        """Matched keypoints (m,2) of the first and of the second image.

        Raises:
            HlocError: when the pair has none.
        """
        pair = self._pair(one, other)
        if pair is None:
            raise HlocError(
                f"{self._path} has no matches of {one} and {other}: was it made with another list "
                "of pairs?"
            )
        matches, turned = pair
        rows = np.flatnonzero(matches != _NONE)
        pairs = np.column_stack([rows, matches[rows]])
        return pairs[:, ::-1] if turned else pairs

    def _pair(self, one: str, other: str) -> tuple[IntArray, bool] | None:
        """The matches of a pair, and whether they are those of the second with the first."""
        names = tuple(name.replace("/", "-") for name in (one, other))
        for separator in _SEPARATORS:
            for turned in (False, True):
                key = separator.join(names[::-1] if turned else names)
                try:
                    if key not in self._file:
                        continue
                    values: NDArray[Any] = np.asarray(self._file[key][_MATCHES][()])
                except _DAMAGES:
                    values = np.zeros(0)
                if values.ndim != 1 or values.dtype.kind not in "iu":
                    raise HlocError(f"{self._path}: {key} has no {_MATCHES} of whole numbers (n,)")
                return values.astype(np.int64), turned
        return None


@contextmanager
def open_h5(path: Path) -> Iterator[H5File]:
    """Open a file of features or of matches.

    Raises:
        HlocError: when it is no HDF5 file, ImportError without h5py.
    """
    import h5py  # optional

    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise HlocError(f"{path} cannot be read as HDF5: {error}") from error
    with file:
        yield H5File(path, file)


def result_name(query: str, with_camera: bool) -> str:
    """How hloc names a query in its results: without its folders, but perhaps for the last."""
    words = query.split("/")
    return "/".join(words[-2:] if with_camera else words[-1:])


def result_line(name: str, quaternion: Array, translation: Array) -> str:
    """``name qw qx qy qz tx ty tz`` of a pose camera_from_map; quaternion x y z w."""
    x, y, z, w = quaternion.tolist()
    return " ".join([name, *map(repr, [w, x, y, z, *translation.tolist()])])


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbers and texts of the lines that say something."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise HlocError(f"{path} cannot be read as text: {error}") from error
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            yield number, line.strip()
