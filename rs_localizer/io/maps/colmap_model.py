"""Sparse models of COLMAP: the points and by which features of which images they are seen.

Read is ``points3D.bin`` or ``points3D.txt`` alone. pycolmap, which reads whole models, is no help
here: it takes a count in a damaged file at its word and allocates for it, and there is none for
ARM, on which robots run.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.io.maps.landmarks import MapError

# Id, x, y, z, color, error, length of the track; then image and feature of each observation.
_POINT = struct.Struct("<Q3d3BdQ")
_OBSERVATION = np.dtype([("image", "<u4"), ("feature", "<u4")])


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The points of a model and who sees them."""

    ids: NDArray[np.int64]  # (n,)
    points: Array  # (n,3)
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
    (count,) = struct.unpack_from("<Q", data)
    if 8 + count * _POINT.size > len(data):
        raise MapError(f"points3D.bin is truncated: {count} points, found {len(data)} bytes")
    ids = np.empty(count, np.uint64)
    points = np.empty((count, 3))
    starts = np.zeros(count + 1, np.int64)
    tracks: list[bytes] = []
    position = 8
    for row in range(count):
        end = position + _POINT.size
        if end <= len(data):
            ids[row], *xyz, _, _, _, _, length = _POINT.unpack_from(data, position)
            position, end = end, end + length * _OBSERVATION.itemsize
        if end > len(data):
            raise MapError(f"points3D.bin is truncated at point {row + 1} of {count}")
        points[row] = xyz
        starts[row + 1] = starts[row] + length
        tracks.append(data[position:end])
        position = end
    if count and int(ids.max()) >= 2**63:
        raise MapError(f"points3D.bin has a point with the id {ids.max()}")
    return Model(
        ids.astype(np.int64), points, np.frombuffer(b"".join(tracks), _OBSERVATION), starts
    )


def _read_text(path: Path) -> Model:
    ids: list[int] = []
    points: list[tuple[float, float, float]] = []
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
                track = np.array([int(word) for word in words[8:]], np.int64)
                if not 0 <= ids[-1] < 2**63 or np.any((track < 0) | (track >= 2**32)):
                    raise ValueError
            except (ValueError, OverflowError):
                found = line[:80].decode("ascii", "replace").strip()
                raise MapError(
                    f"points3D.txt, line {number}: expected ID X Y Z R G B ERROR and pairs of "
                    f"image and feature, found {found!r}"
                ) from None
            tracks.append(track.astype(np.uint32))
    starts = np.cumsum([0, *(len(track) // 2 for track in tracks)], dtype=np.int64)
    flat = np.concatenate([*tracks, np.zeros(0, np.uint32)])
    return Model(
        np.array(ids, np.int64),
        np.array(points, np.float64).reshape(-1, 3),
        np.ascontiguousarray(flat, "<u4").view(_OBSERVATION),
        starts,
    )
