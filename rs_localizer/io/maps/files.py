# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that hold maps: which there are, and how they are read and written."""

from pathlib import Path

from rs_localizer.io.maps.colmap import read_colmap
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.io.maps.npz import read_npz, write_npz
from rs_localizer.io.maps.ply import read_ply, write_ply
from rs_localizer.io.remote import Location, local_copy

_READERS = {".npz": read_npz, ".ply": read_ply}
WRITERS = {".npz": write_npz, ".ply": write_ply}


def read_map_file(path: Location, frame: str, database: Path | None = None) -> Map:
    """Read a map: a folder of COLMAP, a NumPy archive (.npz) or a PLY file (.ply).

    Args:
        path: of the file or folder, or its URL.
        frame: in which its points are given; files do not say.
        database: COLMAP's, where it is not near the model.

    Raises:
        MapError: for anything that is no map, naming the file and what was found.
        OSError: for a file that is not there or cannot be read.
    """
    with local_copy(path) as file:
        file.stat()  # what does not exist is said to be so
        try:
            if file.is_dir():
                return read_colmap(file, frame, database)
            if database is not None:
                raise MapError("it is not a folder of COLMAP, which alone has a database")
            if file.suffix not in _READERS:
                endings = ", ".join(_READERS)
                raise MapError(f"expected a folder of COLMAP or a file ending in {endings}")
            return _READERS[file.suffix](file, frame)
        except MapError as error:
            raise MapError(f"{path}: {error}") from error


def write_map_file(path: Path | str, landmarks: Map) -> None:
    """Write a map to a .npz or .ply file; raises MapError for another name, OSError as any file."""
    path = Path(path)
    if path.suffix not in WRITERS:
        raise MapError(f"{path}: maps are written to files ending in {', '.join(WRITERS)}")
    WRITERS[path.suffix](path, landmarks)
