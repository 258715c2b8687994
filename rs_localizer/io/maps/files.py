# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that hold maps: which there are, and how they are read and written.

NumPy archives hold ``points`` (n,3) and what else is known: ``ids`` (n,), ``descriptors`` (n,d),
``covariances`` (n,3,3; m^2, NaN: not known) and ``error_modes`` (n,3,k; m). Nothing in them is
ever unpickled.
"""

import warnings
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from rs_localizer.io.maps.colmap import read_colmap
from rs_localizer.io.maps.landmarks import Map, MapError, make_map

SUFFIX = ".npz"
_ARRAYS = ("points", "ids", "descriptors", "covariances", "error_modes")
# Limit of all arrays together: for example ten million landmarks with 128 bytes.
_MOST_BYTES = 2 * 2**30
# Maps hold measured numbers, which deflate packs no better than this beside some bytes of zeros.
_BEST_PACKING, _ZEROS = 20, 2**25


def _arrays(file: IO[bytes]) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(file) as archive:
            sizes = np.array([(it.compress_size, it.file_size) for it in archive.infolist()])
        packed, size = sizes.reshape(-1, 2).sum(axis=0).tolist()
        if size > (most := min(_MOST_BYTES, _BEST_PACKING * packed + _ZEROS)):
            raise MapError(f"the arrays are larger than {most / 1e6:.0f} MB: no measured map is")
        file.seek(0)
        with np.load(file) as archive:  # never unpickled
            if "points" not in archive:
                names = ", ".join(sorted(archive)[:10]) or "none"
                raise MapError(f"the archive has no array 'points'; found {names}")
            return {name: np.asarray(archive[name]) for name in _ARRAYS if name in archive}
    except MapError:
        raise
    except Exception as error:  # damaged files show as errors of zipfile, zlib, NumPy and more
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MapError(f"no readable NumPy archive: {reason}") from error


def write_npz(path: Path, landmarks: Map) -> None:
    """Write a map, which reads back the same to the last bit."""
    arrays = {name: getattr(landmarks, name) for name in _ARRAYS}
    with path.open("wb") as file:  # given a name, NumPy would append a suffix
        np.savez(file, **{name: array for name, array in arrays.items() if array is not None})


def read_map_file(path: Path | str, frame: str) -> Map:
    """Read a map: a folder of COLMAP or a NumPy archive (.npz).

    Args:
        path: of the file or folder.
        frame: in which its points are given; files do not say.

    Raises:
        MapError: for anything that is no map, naming the file and what was found.
        OSError: for a file that is not there or cannot be read.
    """
    file = Path(path)
    file.stat()  # what does not exist is said to be so
    try:
        if file.is_dir():
            return read_colmap(file, frame)
        if not file.is_file():
            raise MapError("it is no plain file: a pipe or device may have no end")
        with file.open("rb") as opened, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns of old headers
            arrays = {"ids": None, "descriptors": None} | _arrays(opened)
        return make_map(frame=frame, **arrays)
    except MapError as error:
        raise MapError(f"{path}: {error}") from error
