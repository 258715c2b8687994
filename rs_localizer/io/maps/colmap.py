# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Sparse models of COLMAP: cameras, images, points with who sees them, and descriptors.

A landmark's descriptor is the medoid of those of the images that see it: the one nearest to the
others. pycolmap, which reads whole models, is no help here: it takes a count in a damaged file at
its word and allocates for it, and there is none for ARM, on which robots run.
"""

import sqlite3
import struct
import time
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.calibration import colmap_camera, colmap_line, colmap_parameters
from rs_localizer.io.maps.landmarks import Map, MapError, make_map

# Id, x, y, z, color, error, length of the track; then image and feature of each observation.
_POINT = struct.Struct("<Q3d3BdQ")
_COUNT = struct.Struct("<Q")
_OBSERVATION = np.dtype([("image", "<u4"), ("feature", "<u4")])


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The points of a model and who sees them."""

    ids: NDArray[np.int64]  # (n,)
    points: Array  # (n,3)
    colors: NDArray[np.uint8]  # (n,3)
    tracks: NDArray[np.void]  # (m,) observations, point by point
    starts: NDArray[np.int64]  # (n+1,) of each track


def read_model(folder: Path) -> Model:
    """Read the points of a model, in its binary or its text form.

    Raises:
        MapError: for anything that is no model, OSError as any file.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    if binary.exists():
        return _read_binary(binary.read_bytes())
    if text.exists():
        return _read_text(text)
    raise MapError(f"the folder has neither {binary.name} nor {text.name}")


def _read_binary(data: bytes) -> Model:
    if len(data) < 8:
        raise MapError("points3D.bin is truncated")
    (count,) = _COUNT.unpack_from(data)
    if 8 + count * _POINT.size > len(data):
        raise MapError(f"points3D.bin is truncated: {count} points, found {len(data)} bytes")
    ids = np.empty(count, np.uint64)
    points, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    starts = np.zeros(count + 1, np.int64)
    tracks: list[bytes] = []
    position = 8
    for row in range(count):
        end = position + _POINT.size
        if end <= len(data):
            ids[row], *values, _, length = _POINT.unpack_from(data, position)
            points[row], colors[row] = values[:3], values[3:]
            position, end = end, end + length * _OBSERVATION.itemsize
        if end > len(data):
            raise MapError(f"points3D.bin is truncated at point {row + 1} of {count}")
        starts[row + 1] = starts[row] + length
        tracks.append(data[position:end])
        position = end
    if count and int(ids.max()) >= 2**63:
        raise MapError(f"points3D.bin has a point with the id {ids.max()}")
    return Model(
        ids.astype(np.int64), points, colors, np.frombuffer(b"".join(tracks), _OBSERVATION), starts
    )


def _read_text(path: Path) -> Model:
    ids: list[int] = []
    points: list[tuple[float, float, float]] = []
    colors: list[list[int]] = []
    tracks: list[NDArray[np.uint32]] = []
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            words = line.split()
            if not words or words[0].startswith(b"#"):
                continue
            try:
                if len(words) < 8 or len(words) % 2:
                    raise ValueError
                ids.append(int(words[0]))
                points.append((float(words[1]), float(words[2]), float(words[3])))
                colors.append([int(word) % 256 for word in words[4:7]])
                track = np.array([int(word) for word in words[8:]], np.int64)
                if not 0 <= ids[-1] < 2**63 or np.any((track < 0) | (track >= 2**32)):
                    raise ValueError
            except (ValueError, OverflowError):
                text = line[:80].decode("ascii", "replace").strip()
                raise MapError(
                    f"points3D.txt, line {number}: expected ID X Y Z R G B ERROR and pairs of "
                    f"image and feature, found {text!r}"
                ) from None
            tracks.append(track.astype(np.uint32))
    starts = np.cumsum([0, *(len(track) // 2 for track in tracks)], dtype=np.int64)
    flat = np.concatenate([*tracks, np.zeros(0, np.uint32)])
    return Model(
        np.array(ids, np.int64),
        np.array(points, np.float64).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
        np.ascontiguousarray(flat, "<u4").view(_OBSERVATION),
        starts,
    )


# Number, quaternion, translation, number of the camera; then the name, ended by a zero.
_IMAGE = struct.Struct("<I7dI")
_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_NO_POINT = -1


@dataclass(frozen=True, slots=True, eq=False)
class ModelImage:
    """An image of a model: where it was taken, and its keypoints as far as the model lists them."""

    number: int
    camera: int
    rotation: Array  # (3,3) camera_from_world
    translation: Array  # (3,)
    pixels: Array  # (m,2), the corner of the first pixel at 0, 0
    points: IntArray  # (m,) ids of the points that they show; -1: none


def read_images(folder: Path) -> dict[str, ModelImage]:
    """A model's images by their names.

    Raises:
        MapError: for anything that is not a model, OSError as any file.
    """
    binary, text = folder / "images.bin", folder / "images.txt"
    if binary.exists():
        images = _read_binary_images(binary.read_bytes())
    elif text.exists():
        images = _read_text_images(text)
    else:
        raise MapError(f"{folder} has neither {binary.name} nor {text.name}")
    if not images:
        raise MapError(f"the model in {folder} has no images")
    return images


def _read_binary_images(data: bytes) -> dict[str, ModelImage]:
    images: dict[str, ModelImage] = {}
    try:
        (count,) = _COUNT.unpack_from(data)
        position = _COUNT.size
        for _ in range(count):
            number, *pose, camera = _IMAGE.unpack_from(data, position)
            start = position + _IMAGE.size
            end = data.index(0, start)
            (features,) = _COUNT.unpack_from(data, end + 1)
            position = end + 1 + _COUNT.size
            # Of a count that lies, NumPy says that the buffer is too small.
            table = np.frombuffer(data, _FEATURE, features, position)
            name = data[start:end].decode("utf-8")
            images[name] = _model_image(number, camera, pose, table)
            position += table.nbytes
    except (struct.error, ValueError, OverflowError) as error:
        raise MapError("images.bin is truncated or damaged") from error
    return images


def _model_image(
    number: int, camera: int, pose: list[float], features: NDArray[np.void]
) -> ModelImage:
    from scipy.spatial.transform import Rotation

    w, x, y, z = pose[:4]
    return ModelImage(
        number,
        camera,
        Rotation.from_quat([x, y, z, w]).as_matrix(),
        np.array(pose[4:]),
        np.column_stack([features["x"], features["y"]]),
        features["point"].astype(np.int64),
    )


def _read_text_images(path: Path) -> dict[str, ModelImage]:
    images: dict[str, ModelImage] = {}
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise MapError(f"{path.name} cannot be read as text: {error}") from error
    lines = [line for line in text.splitlines() if line[:1] != "#"]
    # Every second line lists the features of an image, and may be empty.
    for line, features in zip_longest(lines[::2], lines[1::2], fillvalue=""):
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            if len(words) != 10:
                raise ValueError
            triples = np.array(features.split(), np.float64).reshape(-1, 3)
            # Above 2**53 neighbouring numbers are the same float; NaN is below nothing.
            if not np.all(np.abs(triples[:, 2]) <= 2.0**53) or np.any(triples[:, 2] % 1.0):
                raise ValueError
            table = np.empty(len(triples), _FEATURE)
            table["x"], table["y"], table["point"] = triples.T
            pose = [float(word) for word in words[1:8]]
            images[words[9]] = _model_image(int(words[0]), int(words[8]), pose, table)
        except (ValueError, OverflowError):
            raise MapError(
                f"images.txt: expected ID QW QX QY QZ TX TY TZ CAMERA NAME and a line of X Y POINT "
                f"for each keypoint, found {line[:80]!r}"
            ) from None
    return images


_CAMERA = struct.Struct("<IiQQ")  # number, model, width, height; then the parameters


def read_camera(folder: Path) -> Camera:
    """The one camera of a model.

    Raises:
        MapError: for several, for one that cannot be used, for anything that is no model.
    """
    binary, text = folder / "cameras.bin", folder / "cameras.txt"
    try:
        if binary.exists():
            return colmap_camera(_binary_cameras(binary.read_bytes()), None)
        return colmap_camera(text.read_text(encoding="utf-8"), None)
    except (struct.error, ValueError) as error:
        raise MapError(f"the cameras of the model in {folder}: {error}") from error


def _binary_cameras(data: bytes) -> str:
    """The same as text; of an unknown model, how many parameters it has is not known."""
    (count,) = _COUNT.unpack_from(data)
    if count != 1:
        raise ValueError(f"one is needed, found {count}: images of one camera share their lens")
    number, model, width, height = _CAMERA.unpack_from(data, _COUNT.size)
    values = np.frombuffer(data, "<f8", offset=_COUNT.size + _CAMERA.size)
    return colmap_line(number, model, width, height, values)


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """The points of a model that is written."""

    ids: IntArray  # (n,)
    points: Array  # (n,3)
    colors: NDArray[np.uint8]  # (n,3)
    errors: Array  # (n,) px, mean reprojection error


def write_model(
    folder: Path, camera: Camera, images: dict[str, ModelImage], points: Points
) -> None:
    """Write a model of one camera as text, into a folder that is there.

    Args:
        folder: where to.
        camera: of all images, with the number 1.
        images: by their names; each keypoint's point is one of ``points``, or -1.
        points: with what is said of them.

    Raises:
        ValueError: for a lens that COLMAP has no name for.
    """
    from scipy.spatial.transform import Rotation

    lens = colmap_parameters(camera)
    width, height = camera.size
    tracks: dict[int, list[str]] = {point: [] for point in points.ids.tolist()}
    rows = []
    for name, image in images.items():
        x, y, z, w = Rotation.from_matrix(image.rotation).as_quat(canonical=True)
        rows.append(f"{image.number} {_line([w, x, y, z, *image.translation])} 1 {name}\n")
        shown = list(zip(image.pixels.tolist(), image.points.tolist(), strict=True))
        rows.append(" ".join(f"{u!r} {v!r} {point}" for (u, v), point in shown) + "\n")
        for feature, (_, point) in enumerate(shown):
            if point != _NO_POINT:
                tracks[point].append(f" {image.number} {feature}")
    described = zip(points.ids.tolist(), points.points, points.colors, points.errors, strict=True)
    landmarks = [
        f"{point} {_line(place)} {' '.join(map(str, color))} {float(error)!r}"
        f"{''.join(tracks[point])}\n"
        for point, place, color, error in described
    ]
    cameras = [f"1 {lens['model']} {width} {height} {_line(lens['params'])}\n"]
    for name, lines in (("cameras", cameras), ("images", rows), ("points3D", landmarks)):
        (folder / f"{name}.txt").write_text("".join(lines), encoding="utf-8")


def _line(values: Array | list[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


DATABASE = "database.db"
# Of a track, evenly: some are seen a thousand times.
_MOST_OBSERVATIONS = 32
_SIFT_WIDTH = 128
_WIDEST = 4096
# Of an image: 8192 features of COLMAP take 1 MB, 65,536 of the widest 256 MB.
_MOST_BYTES = 2**28
_PATIENCE = 60.0  # s, for a database of ten thousand images
_IS_TABLE = "SELECT count(*) FROM sqlite_master WHERE type='table' AND name='descriptors'"
# Extractors of COLMAP 3.12 and later; before, there was no such column.
_UNDEFINED, _SIFT = -1, 0


def read_colmap(folder: Path, frame: str, database: Path | None = None) -> Map:
    """Read a sparse model, in its binary or its text form.

    Args:
        folder: with ``points3D.bin`` or ``points3D.txt``.
        frame: of the model.
        database: default: ``database.db`` in the folder or in one of the two above it, where
            COLMAP leaves it, or the only ``.db`` file there that has descriptors; without one the
            map has no descriptors.

    Raises:
        MapError: for anything that is no model, OSError as any file.
    """
    model = read_model(folder)
    if database is None:
        database = _find_database((folder, *folder.resolve().parents[:2]))
    if database is None:
        return make_map(model.points, model.ids, None, frame)
    try:
        descriptors, usable = _descriptors(model, database)
    except MapError as error:
        raise MapError(f"{database}: {error}") from error
    landmarks = make_map(model.points[usable], model.ids[usable], descriptors, frame)
    return replace(landmarks, dropped=landmarks.dropped + int(np.count_nonzero(~usable)))


def _find_database(places: tuple[Path, ...]) -> Path | None:
    for place in places:
        if (place / DATABASE).is_file():
            return place / DATABASE
    for place in places:
        databases = [path for path in sorted(place.glob("*.db")) if _has_descriptors(path)]
        if len(databases) > 1:
            names = ", ".join(path.name for path in databases)
            raise MapError(f"{place} has several databases of COLMAP, {names}: name one")
        if databases:
            return databases[0]
    return None


def _has_descriptors(path: Path) -> bool:
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as tables:
            return bool(tables.execute(_IS_TABLE).fetchone()[0])
    except sqlite3.Error:
        return False


def _descriptors(model: Model, database: Path) -> tuple[NDArray[np.generic], NDArray[np.bool_]]:
    """Descriptors (k,d) of the points that have any, and which points (n,) these are."""
    chosen = _chosen(model)
    observations = model.tracks[chosen]
    described, has_one = _observed(observations, database)
    counts = np.diff(np.searchsorted(chosen, model.starts))
    medoids = np.zeros((len(counts), described.shape[1]), described.dtype)
    usable = np.zeros(len(counts), np.bool_)
    end = 0
    for point, count in enumerate(counts):
        start, end = end, end + count
        rows = described[start:end][has_one[start:end]]
        if len(rows):
            medoids[point], usable[point] = rows[medoid(rows)], True
    if not usable.any():
        raise MapError("no point of the model has a descriptor in it; is it of another model?")
    return (medoids.astype(np.float32) if _numeric(described) else medoids)[usable], usable


def _numeric(descriptors: NDArray[np.generic]) -> bool:
    """Whether they are compared as numbers; COLMAP keeps SIFT as bytes, but numbers they are."""
    return descriptors.dtype == np.float32 or descriptors.shape[1] == _SIFT_WIDTH


def _chosen(model: Model) -> NDArray[np.int64]:
    """Which observations count: of long tracks an even choice."""
    parts = []
    for start, end in zip(model.starts[:-1].tolist(), model.starts[1:].tolist(), strict=True):
        step = -(-(end - start) // _MOST_OBSERVATIONS) or 1
        parts.append(np.arange(start, end, step))
    return np.concatenate([*parts, np.zeros(0, np.int64)])


def _observed(
    observations: NDArray[np.void], database: Path
) -> tuple[NDArray[np.generic], NDArray[np.bool_]]:
    """Descriptors (m,d) of observations (m,), and which of them (m,) are known."""
    has_one = np.zeros(len(observations), np.bool_)
    described: NDArray[np.generic] | None = None
    order = np.argsort(observations["image"], kind="stable")
    images, firsts = np.unique(observations["image"][order], return_index=True)
    groups = np.split(order, firsts[1:]) if len(order) else []
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True)) as tables:
            tables.text_factory = bytes  # of a damaged one, text may be none
            tables.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
            deadline = time.monotonic() + _PATIENCE
            # A view, or a computed column, may stand for any amount of work.
            tables.set_progress_handler(lambda: int(time.monotonic() > deadline), 10_000)
            if not tables.execute(_IS_TABLE).fetchone()[0]:
                raise MapError("it has no table of descriptors")
            columns = [row[1] for row in tables.execute("PRAGMA table_info(descriptors)")]
            kind = "type" if b"type" in columns else str(_SIFT)
            for image, rows in zip(images.tolist(), groups, strict=True):
                part = _of_image(tables, image, kind)
                if part is None:
                    continue
                if described is None:
                    described = np.zeros((len(observations), part.shape[1]), part.dtype)
                if part.shape[1] != described.shape[1] or part.dtype != described.dtype:
                    raise MapError(
                        f"image {image} has descriptors of {part.shape[1]} x {part.dtype}, others "
                        f"of {described.shape[1]} x {described.dtype}"
                    )
                features = observations["feature"][rows]
                there = features < len(part)
                described[rows[there]] = part[features[there]]
                has_one[rows[there]] = True
    except (sqlite3.Error, UnicodeDecodeError) as error:  # which the text of an error may cause
        raise MapError(f"it cannot be read as a database of COLMAP: {error}") from error
    if described is None:
        raise MapError("it has no descriptors of the images of the model")
    return described, has_one


def _of_image(
    tables: sqlite3.Connection, image: int, kind: str
) -> NDArray[np.uint8] | NDArray[np.float32] | None:
    """Descriptors (n,d) of all features of an image."""
    query = f"SELECT rows, cols, data, {kind} FROM descriptors WHERE image_id = ?"
    row = tables.execute(query, (image,)).fetchone()
    if row is None or row[0] == 0:
        return None
    rows, columns, data, extractor = row
    if not isinstance(rows, int) or not isinstance(columns, int) or not isinstance(data, bytes):
        raise MapError(f"the descriptors of image {image} are none")
    if not 0 < columns <= _WIDEST or rows * columns != len(data):
        raise MapError(
            f"image {image}: {rows} descriptors of {columns} bytes, found {len(data)} bytes"
        )
    # Of all extractors but SIFT, which is the first, COLMAP keeps the bytes of floats.
    if extractor in (_UNDEFINED, _SIFT):
        return np.frombuffer(data, np.uint8).reshape(rows, columns)
    if columns % 4:
        raise MapError(f"image {image}: descriptors of {columns} bytes are not floats")
    return np.frombuffer(data, "<f4").astype(np.float32).reshape(rows, columns // 4)


def medoid(rows: NDArray[np.generic]) -> int:
    """The row with the least sum of distances to the others."""
    if len(rows) < 3:
        return 0
    if _numeric(rows):
        values = rows.astype(np.float64)
        distances = np.sqrt(np.square(values[:, None] - values[None]).sum(axis=2))
    else:
        bits = np.unpackbits(rows.view(np.uint8), axis=1)
        distances = np.count_nonzero(bits[:, None] != bits[None], axis=2)
    return int(np.argmin(distances.sum(axis=1)))
