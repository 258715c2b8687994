# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Map files: what is written is read back, what COLMAP wrote is understood, hostile ones refused.

The model in the folder colmap was written by pycolmap 4.2.1 (4 images, 14 points with noise, SIFT
descriptors that differ from view to view); truth.json is what pycolmap's own reader says of it,
with the medoids worked out beside it in plain loops.
"""

import io
import json
import shutil
import sqlite3
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.maps.files import read_map_file, write_map_file
from rs_localizer.io.maps.landmarks import Map, MapError

COLMAP = Path(__file__).parent / "colmap"


VERTICES = [(i, 9, -i, 7 + i, 2.5 * i, 3, i, 1, 2, -1) for i in range(4)]
PLY = {
    "big": b"".join(struct.pack(">fBfIdH3fb", *row) for row in VERTICES),
    "little": b"".join(struct.pack("<fBfIdH3fb", *row) for row in VERTICES),
    "ascii": b"".join(b"%d %d %d %d %g  %d %d %d %d %d\n" % row for row in VERTICES),
}


@pytest.mark.parametrize("form", list(PLY))
def test_ply_of_another_author(tmp_path, form):
    """Properties in any order and type, an element before the vertices, faces after them."""
    header = (
        f"ply\nformat {form if form == 'ascii' else f'binary_{form}_endian'} 1.0\n"
        "comment made by hand\nelement camera 2\nproperty uchar a\nproperty int8 b\n"
        "element vertex 4\nproperty float x\nproperty uchar red\nproperty float32 y\n"
        "property uint id\nproperty double z\nproperty list ushort float descriptor\n"
        "property char more\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    before = b"1 2\n3 4\n" if form == "ascii" else b"\x01\x02\x03\x04"
    path = tmp_path / "map.ply"
    path.write_bytes(header.encode() + before + PLY[form] + b"and whatever follows")
    found = read_map_file(path, "map")
    assert found.points.tolist() == [[i, -i, 2.5 * i] for i in range(4)]
    assert found.ids.tolist() == [7, 8, 9, 10]
    assert found.descriptors.tolist() == [[i, 1, 2] for i in range(4)]


def test_an_archive_with_errors_that_landmarks_share(tmp_path):
    """They come back bit by bit, but for landmarks that are dropped; older archives have none."""
    rng, path = np.random.default_rng(0), tmp_path / "map.npz"
    points, modes = rng.normal(size=(5, 3)), rng.normal(size=(5, 3, 2)).astype(np.float32)
    write_map_file(path, Map(points, np.arange(5), None, "map", error_modes=modes))
    found = read_map_file(path, "map")
    np.testing.assert_array_equal(found.error_modes, modes)
    assert found.error_modes.dtype == np.float32
    modes[1, 2, 0] = np.nan
    np.savez(path, points=points, ids=np.arange(5), error_modes=modes.astype(float))
    found = read_map_file(path, "map")
    assert found.dropped == 1
    np.testing.assert_array_equal(found.error_modes, modes[[0, 2, 3, 4]])
    np.savez(path, points=points, ids=np.arange(5))
    assert read_map_file(path, "map").error_modes is None
    np.savez(path, points=points, ids=np.arange(5), error_modes=modes[:, 0])
    with pytest.raises(MapError, match=r"error_modes must be \(5,3,k\), found \(5, 2\)"):
        read_map_file(path, "map")


@pytest.mark.parametrize("form", ["binary", "text"])
def test_a_model_of_colmap(form):
    truth = json.loads((COLMAP / "truth.json").read_text())
    found = read_map_file(COLMAP / form, "map")  # the database lies one folder above
    assert found.descriptors.dtype == np.float32
    assert set(found.ids.tolist()) == {int(name) for name in truth}
    for number, point, descriptor in zip(
        found.ids.tolist(), found.points.tolist(), found.descriptors.tolist(), strict=True
    ):
        assert point == truth[str(number)]["xyz"]
        assert descriptor == truth[str(number)]["medoid"]


def test_a_model_without_a_database(tmp_path):
    model = tmp_path / "a" / "b" / "sparse"
    shutil.copytree(COLMAP / "binary", model)
    assert read_map_file(model, "map").descriptors is None
    given = read_map_file(model, "map", COLMAP / "database.db")
    assert given.descriptors.shape == (14, 128)


def database(path: Path, *changes: str) -> Path:
    shutil.copy(COLMAP / "database.db", path / "database.db")
    with sqlite3.connect(path / "database.db") as tables:
        for change in changes:
            tables.execute(change)
    tables.close()
    return path / "database.db"


def test_descriptors_of_other_extractors(tmp_path):
    # Binary ones that somebody imported: 32 of the 128 bytes.
    cut = "UPDATE descriptors SET cols = 32, data = CAST(zeroblob(rows * 32) AS BLOB)"
    found = read_map_file(COLMAP / "binary", "map", database(tmp_path, cut))
    assert (found.descriptors.dtype, found.descriptors.shape) == (np.uint8, (14, 32))
    # ALIKED and the like: bytes of floats.
    floats = "UPDATE descriptors SET type = 1, data = CAST(zeroblob(rows * 128) AS BLOB)"
    found = read_map_file(COLMAP / "binary", "map", database(tmp_path, floats))
    assert (found.descriptors.dtype, found.descriptors.shape) == (np.float32, (14, 32))


# Which no point of the model is seen by.
FIRST_FEATURE_OF_IMAGE_2 = (
    "DELETE FROM descriptors WHERE image_id <> 2;"
    "UPDATE descriptors SET rows = 1, data = substr(data, 1, 128)"
)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("UPDATE descriptors SET rows = 4000000000000", "4000000000000 descriptors of 128 bytes"),
        ("UPDATE descriptors SET cols = 64, rows = 2 * rows WHERE image_id = 2", "64 x uint8"),
        ("DROP TABLE descriptors", "no table of descriptors"),
        (FIRST_FEATURE_OF_IMAGE_2, "no point of the model"),
    ],
)
def test_a_bad_database(tmp_path, change, text):
    file = database(tmp_path, *change.split(";"))
    with pytest.raises(MapError, match=text):
        read_map_file(COLMAP / "binary", "map", file)
    file.write_bytes(b"no database at all, but long enough to look like one" * 30)
    with pytest.raises(MapError, match="cannot be read as a database"):
        read_map_file(COLMAP / "binary", "map", file)


def npy(shape: tuple[int, ...], kind: str, data: bytes = b"") -> bytes:
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data


def archive(path: Path, compression: int = zipfile.ZIP_STORED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


class Bomb:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("/tmp/rs_localizer_was_here"),))


def pickled() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.array([Bomb(), None]), allow_pickle=True)
    return stream.getvalue()


ONE = np.ones(3).tobytes()


@pytest.mark.parametrize(
    ("members", "text"),
    [
        ({"points": npy((10**12, 3), "<f8", ONE)}, "takes 24000000000\\d* bytes, found"),
        ({"points": npy((2**62, 2**62), "<f8", ONE)}, "its shape takes"),
        ({"points": npy((1, 3, 10**9, 0), "<f8")}, r"must be \(n,3\) numbers"),
        ({"points": pickled()}, "must hold numbers, found object"),
        ({"ids": npy((1,), "<i8", bytes(8))}, "no array 'points'; found ids.npy"),
        ({"points": npy((1, 3), "<f8", ONE), "ids": npy((1,), "<i8", b"\xff" * 7 + b"\x7f")},
         "ids must lie between"),
        ({"points": npy((1, 3), "<f8", ONE), "descriptors": npy((2, 2), "|u1", bytes(4))},
         r"descriptors must be \(1,d\), found \(2, 2\)"),
    ],
)  # fmt: skip
def test_a_bad_archive(tmp_path, members, text):
    path = archive(tmp_path / "map.npz", **members)
    with pytest.raises(MapError, match=text) as caught:
        read_map_file(path, "map")
    assert str(caught.value).startswith(f"{path}: ")
    assert not Path("/tmp/rs_localizer_was_here").exists()


def changed_header(path: Path, offset: int, value: int) -> None:
    """Change a field of the central directory's first entry."""
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + offset, value)
    path.write_bytes(data)


def test_sizes_that_an_archive_claims(tmp_path):
    path = archive(tmp_path / "a.npz", points=npy((1, 3), "<f8", ONE))
    changed_header(path, 24, 2**32 - 2)  # the size unpacked
    with pytest.raises(MapError, match="larger than 2 GiB"):
        read_map_file(path, "map")
    path = archive(tmp_path / "b.npz", zipfile.ZIP_DEFLATED, points=npy((1, 3), "<f8", ONE))
    changed_header(path, 24, 2**30)
    with pytest.raises(MapError, match="cannot unpack to"):
        read_map_file(path, "map")
    path = archive(tmp_path / "c.npz", zipfile.ZIP_LZMA, points=npy((1, 3), "<f8", ONE))
    with pytest.raises(MapError, match="packed by method 14"):
        read_map_file(path, "map")


def ply(count: str = "1", properties: str = "", data: bytes = b"") -> bytes:
    start = "ply\nformat binary_little_endian 1.0\n"
    return f"{start}element vertex {count}\n{properties}end_header\n".encode() + data


def text_ply(count: int, data: bytes, properties: str) -> bytes:
    return ply(str(count), properties, data).replace(b"binary_little_endian", b"ascii")


XYZ = "".join(f"property float {name}\n" for name in "xyz")
LIST = XYZ + "property list uint float descriptor\n"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "the first line is not 'ply'"),
        (b"ply\n" + b"comment\n" * 2000, "more than 1000 lines"),
        (ply(str(10**12), XYZ), f"truncated: {10**12} x vertex take at least {12 * 10**12} bytes"),
        (ply("1", LIST, bytes(12) + struct.pack("<I", 2**32 - 1)), "1 to 65535 values, found"),
        (ply("2", LIST, bytes(12) + struct.pack("<If", 1, 0) + bytes(20)),
         "must be equally long, found 0 to 1 values"),
        (ply("2", XYZ + "property int id\n", bytes(32)), "1 ids stand for several .* first .* 0"),
        (ply("1", XYZ, struct.pack("<3f", np.nan, 0, 0)), "no landmarks; 1 with NaN"),
        (text_ply(2, b"1 2 30\n1   2", XYZ), "vertex 2 of 2 must have 3 numbers, found 2"),
        (text_ply(1, b"1 2 256\n", XYZ.replace("float z", "uchar z")), "z holds what is not"),
    ],
)  # fmt: skip
def test_a_bad_ply(tmp_path, data, text):
    path = tmp_path / "map.ply"
    path.write_bytes(data)
    with pytest.raises(MapError, match=text):
        read_map_file(path, "map")


@pytest.mark.parametrize(
    ("name", "data", "text"),
    [
        ("points3D.bin", struct.pack("<Q", 10**12), "truncated: 1000000000000 points"),
        ("points3D.bin", struct.pack("<Q", 1) + bytes(43) + b"\xff" * 8, "truncated at point 1"),
        ("points3D.txt", b"1 2 3\n", "line 1: expected ID X Y Z"),
        ("cameras.bin", b"", "neither points3D.bin nor points3D.txt"),
    ],
)
def test_a_bad_model(tmp_path, name, data, text):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(MapError, match=text):
        read_map_file(tmp_path, "map")


@pytest.mark.parametrize("name", ["a.npz", "b.ply", "c.ply", "d"])
def test_hostile_sizes_allocate_nothing(tmp_path, name):
    path = tmp_path / name
    if name == "a.npz":
        archive(path, points=npy((10**12, 3), "<f8", ONE))
    elif name == "d":
        path.mkdir()
        (path / "points3D.bin").write_bytes(struct.pack("<Q", 10**12))
    else:
        lists = ply("1", LIST, bytes(12) + b"\xff\xff\x00\x00")
        path.write_bytes(ply(str(10**12), XYZ) if name == "b.ply" else lists)
    tracemalloc.start()
    with pytest.raises(MapError):
        read_map_file(path, "map")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20
