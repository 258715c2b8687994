# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that hold maps: which there are, and how they are read and written.

NumPy archives hold ``points`` (n,3) and what else is known: ``ids`` (n,), ``descriptors`` (n,d),
``covariances`` (n,3,3; m^2, NaN: not known) and ``error_modes`` (n,3,k; m). Nothing in them is
ever unpickled, and nothing is allocated before the headers of the arrays, the sizes in the archive
and the size of the file agree.
"""

import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.io.maps.colmap import read_colmap
from rs_localizer.io.maps.landmarks import Map, MapError, make_map

SUFFIX = ".npz"
_ARRAYS = ("points", "ids", "descriptors", "covariances", "error_modes")
# Limit of all arrays together, as floats of 8 bytes: for example ten million landmarks with 128
# bytes.
_MOST_BYTES = 2 * 2**30
# Maps hold measured numbers, which deflate packs no better than this beside some bytes of zeros.
_BEST_PACKING, _ZEROS = 20, 2**25
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_LONGEST_HEADER = 10_000
# Exceptions that zipfile, zlib and NumPy raise for damaged files.
_DAMAGES = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError,
    ValueError, KeyError, OverflowError, SyntaxError, TypeError, OSError, tokenize.TokenError,
)  # fmt: skip


def read_npz(path: Path, frame: str) -> Map:
    """Read a map; raises MapError for anything that is none, OSError as any file."""
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns of old headers
        arrays = _arrays(file)
    return make_map(
        arrays["points"], arrays.get("ids"), arrays.get("descriptors"), frame,
        arrays.get("covariances"), arrays.get("error_modes"),
    )  # fmt: skip


def _arrays(file: IO[bytes]) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(file) as archive:
            members = {info.filename: info for info in archive.infolist()}
            wanted = [members[f"{name}.npy"] for name in _ARRAYS if f"{name}.npy" in members]
            if "points.npy" not in members:
                names = ", ".join(sorted(members)[:10]) or "none"
                raise MapError(f"the archive has no array 'points'; found {names}")
            packed = sum(info.compress_size for info in wanted)
            most = min(_MOST_BYTES, _BEST_PACKING * packed + _ZEROS)
            if sum(_checked(archive, info) for info in wanted) > most:
                raise MapError(
                    f"the arrays are larger than {most / 1e6:.0f} MB: no measured map is"
                )
            return {info.filename[:-4]: _read(archive, info) for info in wanted}
    except MapError:
        raise
    except _DAMAGES as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MapError(f"no readable NumPy archive: {reason}") from error


def write_npz(path: Path, landmarks: Map) -> None:
    """Write a map, which reads back the same to the last bit."""
    arrays = {name: getattr(landmarks, name) for name in _ARRAYS}
    with path.open("wb") as file:  # given a name, NumPy would append a suffix
        np.savez(file, **{name: array for name, array in arrays.items() if array is not None})


def _checked(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> int:
    """Return the bytes that an array takes, if its header and its size in the archive agree."""
    name = info.filename
    if info.compress_type not in _COMPRESSIONS:
        raise MapError(f"{name} is packed by method {info.compress_type}, which NumPy never uses")
    with archive.open(info) as file:
        header, count, itemsize = _size(file, name)
    if header + count * itemsize != info.file_size:
        raise MapError(
            f"{name}: its shape takes {header + count * itemsize} bytes, found {info.file_size}"
        )
    return count * (itemsize if name == "descriptors.npy" else max(8, itemsize))


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(info) as file:
        array: NDArray[Any] = np.lib.format.read_array(
            file, allow_pickle=False, max_header_size=_LONGEST_HEADER
        )
    return array


def _size(file: IO[bytes], name: str) -> tuple[int, int, int]:
    """Return bytes of a member's header, and the count and the bytes of its numbers."""
    version = np.lib.format.read_magic(file)
    readers = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in readers:
        raise MapError(f"{name} has version {version[0]}.{version[1]} of the format")
    shape, _, kind = readers[version](file, max_header_size=_LONGEST_HEADER)
    if kind.hasobject or kind.kind not in "fiu":
        raise MapError(f"{name} must hold numbers, found {kind}")
    if min(shape, default=0) < 0:
        raise MapError(f"{name} has the shape {shape}")
    return file.tell(), math.prod(shape), kind.itemsize  # Python integers do not overflow


def read_map_file(path: Path | str, frame: str, database: Path | None = None) -> Map:
    """Read a map: a folder of COLMAP or a NumPy archive (.npz).

    Args:
        path: of the file or folder.
        frame: in which its points are given; files do not say.
        database: COLMAP's, where it is not near the model.

    Raises:
        MapError: for anything that is no map, naming the file and what was found.
        OSError: for a file that is not there or cannot be read.
    """
    file = Path(path)
    file.stat()  # what does not exist is said to be so
    try:
        if file.is_dir():
            return read_colmap(file, frame, database)
        if not file.is_file():
            raise MapError("it is no plain file: a pipe or device may have no end")
        if database is not None:
            raise MapError("it is not a folder of COLMAP, which alone has a database")
        return read_npz(file, frame)
    except MapError as error:
        raise MapError(f"{path}: {error}") from error
