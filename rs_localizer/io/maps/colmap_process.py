# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""pycolmap at work, run by its path (see ``limited.py``): a sparse model -> arrays.

In one process with OpenCV it aborts on some machines ("free(): invalid pointer"), and it takes a
count in a damaged file at its word.
"""

import itertools
import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

_NO_POINT = 2**64 - 1
# Descriptors that are read per track, evenly chosen: some landmarks are seen a thousand times.
_MOST_OBSERVATIONS = 32
_SIFT_WIDTH = 128
# Extractors of COLMAP 3.12 and later; before, there was no such column.
_UNDEFINED, _SIFT = -1, 0


def read(folder: str) -> dict[str, Any]:
    """Read points, images and cameras of a model; what belongs to one of them stands in one row."""
    import pycolmap

    pycolmap.logging.minloglevel = 3
    model = pycolmap.Reconstruction(folder)
    points = sorted(model.points3D.items())
    images = [item for item in sorted(model.images.items()) if _called(item[1].has_pose)]
    tracks = [[(e.image_id, e.point2D_idx) for e in point.track.elements] for _, point in points]
    poses = [_called(image.cam_from_world).matrix() for _, image in images]
    features = [image.points2D for _, image in images]
    flat = [feature for some in features for feature in some]
    shown = [feature.point3D_id for feature in flat]
    return {
        "ids": np.array([number for number, _ in points], np.uint64),
        "points": np.array([point.xyz for _, point in points], float).reshape(-1, 3),
        "colors": np.array([point.color for _, point in points], np.uint8).reshape(-1, 3),
        "tracks": np.array([pair for track in tracks for pair in track], np.int64).reshape(-1, 2),
        "starts": np.cumsum([0, *map(len, tracks)]),
        "images": np.array([(n, image.camera_id) for n, image in images], np.int64).reshape(-1, 2),
        "names": np.array([image.name for _, image in images], np.str_),
        "rotations": np.array([pose[:, :3] for pose in poses]).reshape(-1, 3, 3),
        "translations": np.array([pose[:, 3] for pose in poses]).reshape(-1, 3),
        "pixels": np.array([feature.xy for feature in flat], float).reshape(-1, 2),
        "shown": np.array([-1 if n == _NO_POINT else n for n in shown], np.int64),
        "features": np.cumsum([0, *map(len, features)]),
        "cameras": np.array([_camera(*item) for item in sorted(model.cameras.items())], np.str_),
    }


def _called(member: Any) -> Any:
    """Return the value of what is a property in some versions and a method in others."""
    return member() if callable(member) else member


def _camera(number: int, camera: Any) -> str:
    """Return the line of ``cameras.txt``."""
    values = " ".join(repr(float(value)) for value in camera.params)
    return f"{number} {camera.model.name} {camera.width} {camera.height} {values}"


def describe(found: dict[str, Any], database: str) -> dict[str, Any]:
    """Return descriptors (k,d) of the points that have any, and the mask (n,) of these points.

    A landmark's descriptor is the medoid of its descriptors in images: the one nearest to the
    others.
    """
    tracks, starts, per_image = found["tracks"], found["starts"], {}
    with closing(sqlite3.connect(f"{Path(database).resolve().as_uri()}?mode=ro", uri=True)) as file:
        columns = [row[1] for row in file.execute("PRAGMA table_info(descriptors)")]
        kind = "type" if "type" in columns else str(_SIFT)
        query = f"SELECT rows, data, {kind} FROM descriptors WHERE image_id = ?"
        for image in np.unique(tracks[:, 0]).tolist():
            row = file.execute(query, (image,)).fetchone()
            rows, data, extractor = row or (0, b"", _SIFT)
            # For all extractors but SIFT, the first one, COLMAP stores the bytes of floats.
            kind_of = np.uint8 if extractor in (_UNDEFINED, _SIFT) else np.dtype("<f4")
            if rows:
                per_image[image] = np.frombuffer(data, kind_of).reshape(rows, -1)
    shapes = {(part.shape[1], part.dtype.str) for part in per_image.values()}
    if len(shapes) != 1:
        raise ValueError(f"the descriptors of its images are of {len(shapes)} kinds, not of one")
    medoids, usable = [], np.zeros(len(starts) - 1, bool)
    for point, (start, end) in enumerate(itertools.pairwise(starts.tolist())):
        track = tracks[start : end : -(-(end - start) // _MOST_OBSERVATIONS) or 1].tolist()
        rows = [per_image[i][f] for i, f in track if i in per_image and f < len(per_image[i])]
        if rows:
            medoids.append(rows[_medoid(np.array(rows))])
            usable[point] = True
    if not medoids:
        raise ValueError("no point of the model has a descriptor in it; is it of another model?")
    described = np.array(medoids)
    return {"descriptors": described.astype(np.float32) if _numeric(described) else described,
            "usable": usable}  # fmt: skip


def _numeric(descriptors: Any) -> bool:
    """Return True if descriptors are compared as numbers, as SIFT, which COLMAP keeps as bytes."""
    return bool(descriptors.dtype.kind == "f" or descriptors.shape[1] == _SIFT_WIDTH)


def _medoid(rows: Any) -> int:
    """Return the row with the least sum of distances to the others."""
    if len(rows) < 3:
        return 0
    if _numeric(rows):
        values = rows.astype(np.float64)
        distances = np.sqrt(np.square(values[:, None] - values[None]).sum(axis=2))
    else:
        bits = np.unpackbits(rows, axis=1)
        distances = np.count_nonzero(bits[:, None] != bits[None], axis=2)
    return int(np.argmin(distances.sum(axis=1)))


def main(task: dict[str, Any], out: str) -> None:
    where = task["folder"]
    try:
        found = read(where)
        if where := task["database"]:
            found |= describe(found, where)
    except Exception as error:
        sys.exit(f"{where}: {' '.join(str(error).split()) or type(error).__name__}")
    np.savez(out, **found)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")), sys.argv[2])
