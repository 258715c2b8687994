"""Maps as PLY files: vertices with ``x y z``, and ``id`` and the list ``descriptor`` where known.

Descriptors are lists of ``uchar`` or ``float``, equally long at all vertices. Other properties, as
colors and normals, are skipped.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.io.maps.landmarks import Map, MapError, make_map
from rs_localizer.io.maps.vertices import PlyError, read_vertices, write_vertices


def read_ply(path: Path, frame: str) -> Map:
    """Read a map; raises MapError for anything that is none, OSError as any file."""
    try:
        table = read_vertices(path)
    except PlyError as error:
        raise MapError(str(error)) from error
    names = table.dtype.names or ()
    if missing := [name for name in "xyz" if name not in names]:
        raise MapError(
            f"the vertices have no property {', '.join(missing)}; found {', '.join(names)}"
        )
    for name in ("x", "y", "z", "id"):
        if name in names and table.dtype[name].shape:
            raise MapError(f"property {name} must be one number, found a list")
    return make_map(
        np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1),
        table["id"] if "id" in names else None,
        table["descriptor"] if "descriptor" in names else None,
        frame,
    )


def write_ply(path: Path, landmarks: Map, *, binary: bool = True) -> None:
    """Write a map; what is read back is the same to the last bit, from text too.

    Raises:
        MapError: for descriptors too long for a PLY file.
    """
    kinds: list[tuple[Any, ...]] = [(name, "<f8") for name in "xyz"]
    if landmarks.ids is not None:
        kinds.append(("id", landmarks.id_type))
    if landmarks.descriptors is not None:
        kinds.append(("descriptor", landmarks.descriptors.dtype, landmarks.descriptors.shape[1:]))
    table = np.empty(len(landmarks), kinds)
    for column, name in enumerate("xyz"):
        table[name] = landmarks.points[:, column]
    if landmarks.ids is not None:
        table["id"] = landmarks.ids
    if landmarks.descriptors is not None:
        table["descriptor"] = landmarks.descriptors
    try:
        write_vertices(path, table, binary=binary)
    except PlyError as error:
        raise MapError(str(error)) from error
