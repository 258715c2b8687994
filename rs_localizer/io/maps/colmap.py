# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Sparse models of COLMAP: cameras, images, points with their observations, and descriptors.

They are read by pycolmap (extra ``mapping``), in a process of its own
(:mod:`rs_localizer.io.maps.colmap_process`). Where there is none (ARM), ``map align`` elsewhere
makes a ``.npz`` of a model.
"""

from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import colmap_camera, colmap_parameters
from rs_localizer.io.maps.landmarks import Map, MapError, make_map
from rs_localizer.io.reading import LimitedError, run_limited

_SCRIPT = Path(__file__).with_name("colmap_process.py")
_FILES = ("cameras", "images", "points3D")
# Limits of the process: memory in bytes, beside this many for each byte of the files, and time (s).
_MEMORY, _A_BYTE = 1_000_000_000, 40
_SECONDS, _BYTES_A_SECOND = 30, 1_000_000
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


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A sparse model."""

    ids: NDArray[np.int64]  # (n,) of the points
    points: Array  # (n,3)
    colors: NDArray[np.uint8]  # (n,3)
    images: dict[str, ModelImage]  # by their names
    cameras: tuple[str, ...]  # as lines of COLMAP's cameras.txt
    descriptors: NDArray[np.generic] | None  # (k,d) of points; None: without a database
    described: NDArray[np.bool_]  # (n,) which points have a descriptor

    @property
    def camera(self) -> Camera:
        """The one camera; MapError for several, or for one that cannot be used."""
        try:
            return colmap_camera("\n".join(self.cameras), None)
        except ValueError as error:
            raise MapError(f"the cameras of the model: {error}") from error


def read_model(folder: Path, database: Path | None = None) -> Model:
    """Read a model, in its binary or its text form.

    Args:
        folder: of the model.
        database: of COLMAP, with the descriptors; None: they are not read.

    Raises:
        MapError: for anything that is no model.
        ImportError: without pycolmap.
    """
    files = [folder / f"{name}{form}" for name in _FILES for form in (".bin", ".txt")]
    sizes = [file.stat().st_size for file in files if file.is_file()]
    if len(sizes) < len(_FILES):
        raise MapError(
            f"{folder} is no model of COLMAP: it needs {', '.join(_FILES)}, .bin or .txt"
        )
    if find_spec("pycolmap") is None:
        raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")
    size = sum(sizes) + (database.stat().st_size if database is not None else 0)
    task = {"folder": str(folder), "database": None if database is None else str(database)}
    limits = _MEMORY + _A_BYTE * size, _SECONDS + size // _BYTES_A_SECOND
    try:
        found = run_limited(_SCRIPT, task, *limits)
    except LimitedError as error:
        raise MapError(f"pycolmap cannot read it: {error}") from error
    parts = np.split(np.arange(len(found["pixels"])), found["features"][1:-1])
    of_images = zip(found["names"].tolist(), found["images"].tolist(), parts, strict=False)
    images = {
        name: ModelImage(
            number, camera, found["rotations"][k], found["translations"][k],
            found["pixels"][rows], found["shown"][rows],
        )
        for k, (name, (number, camera), rows) in enumerate(of_images)
    }  # fmt: skip
    if len(found["ids"]) and int(found["ids"].max()) >= 2**63:
        raise MapError(f"it has a point with the id {found['ids'].max()}")
    usable = found.get("usable", np.ones(len(found["ids"]), bool))
    return Model(
        found["ids"].astype(np.int64), found["points"], found["colors"], images,
        tuple(found["cameras"].tolist()), found.get("descriptors"), usable,
    )  # fmt: skip


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
        points: with their errors and tracks.

    Raises:
        ValueError: for a lens that COLMAP has no name for.
    """
    lens = colmap_parameters(camera)
    width, height = camera.size
    tracks: dict[int, list[str]] = {point: [] for point in points.ids.tolist()}
    rows = []
    for name, image in images.items():
        x, y, z, w = so3.quaternion(np.ascontiguousarray(image.rotation))
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


def read_colmap(folder: Path, frame: str) -> Map:
    """Read the landmarks of a model.

    Their descriptors are in ``database.db`` in the folder or in one of the two above it, where
    COLMAP leaves it; without one the map has none.

    Args:
        folder: of the model.
        frame: of the model.

    Raises:
        MapError: for anything that is no model.
        ImportError: without pycolmap.
    """
    places = (place / DATABASE for place in (folder, *folder.resolve().parents[:2]))
    model = read_model(folder, next(filter(Path.is_file, places), None))
    usable = model.described
    landmarks = make_map(model.points[usable], model.ids[usable], model.descriptors, frame)
    return replace(landmarks, dropped=landmarks.dropped + int(np.count_nonzero(~usable)))
