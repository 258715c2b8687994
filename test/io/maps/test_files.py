# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Map files: what is written or sent is read back, COLMAP's are understood, hostile ones refused.

The model in the folder colmap was written by pycolmap 4.2.1 (4 images, 14 points with noise, SIFT
descriptors that differ from view to view); truth.json is what pycolmap's own reader says of it,
with the medoids worked out beside it in plain loops; images and camera were written by hand.
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

from benchmarks.fuzzing import map_rows
from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud, read_map
from rs_localizer.io.maps.files import read_map_file, write_npz
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.io.messages import MessageError

COLMAP = Path(__file__).parent / "colmap"


def test_an_archive_with_errors_that_landmarks_share(tmp_path):
    """They come back bit by bit, but for landmarks that are dropped; older archives have none."""
    rng, path = np.random.default_rng(0), tmp_path / "map.npz"
    points, modes = rng.normal(size=(5, 3)), rng.normal(size=(5, 3, 2)).astype(np.float32)
    write_npz(path, Map(points, np.arange(5), None, "map", error_modes=modes))
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
def test_a_model_of_colmap(form, tmp_path):
    truth = json.loads((COLMAP / "truth.json").read_text())
    found = read_map_file(COLMAP / form, "map")  # the database lies one folder above
    assert found.descriptors.dtype == np.float32
    assert set(found.ids.tolist()) == {int(name) for name in truth}
    for number, point, descriptor in zip(
        found.ids.tolist(), found.points.tolist(), found.descriptors.tolist(), strict=True
    ):
        assert point == truth[str(number)]["xyz"]
        assert descriptor == truth[str(number)]["medoid"]
    model = tmp_path / "a" / "b" / "sparse"
    shutil.copytree(COLMAP / form, model)
    assert read_map_file(model, "map").descriptors is None
    shutil.copy(COLMAP / "database.db", model)
    assert read_map_file(model, "map").equals(found)


def model_with(path: Path, *changes: str) -> Path:
    shutil.copytree(COLMAP / "binary", path, dirs_exist_ok=True)
    shutil.copy(COLMAP / "database.db", path)
    with sqlite3.connect(path / "database.db") as tables:
        for change in changes:
            tables.execute(change)
    tables.close()
    return path


def test_descriptors_of_other_extractors(tmp_path):
    # Binary ones that somebody imported: 32 of the 128 bytes.
    cut = "UPDATE descriptors SET cols = 32, data = CAST(zeroblob(rows * 32) AS BLOB)"
    found = read_map_file(model_with(tmp_path, cut), "map")
    assert (found.descriptors.dtype, found.descriptors.shape) == (np.uint8, (14, 32))
    # ALIKED and the like: bytes of floats.
    floats = "UPDATE descriptors SET type = 1, data = CAST(zeroblob(rows * 128) AS BLOB)"
    found = read_map_file(model_with(tmp_path, floats), "map")
    assert (found.descriptors.dtype, found.descriptors.shape) == (np.float32, (14, 32))


# Which no point of the model is seen by.
FIRST_FEATURE_OF_IMAGE_2 = (
    "DELETE FROM descriptors WHERE image_id <> 2;"
    "UPDATE descriptors SET rows = 1, data = substr(data, 1, 128)"
)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("UPDATE descriptors SET rows = 4000000000000", "cannot reshape"),
        ("UPDATE descriptors SET cols = 64, rows = 2 * rows WHERE image_id = 2", "of 2 kinds"),
        ("DROP TABLE descriptors", "no such table"),
        (FIRST_FEATURE_OF_IMAGE_2, "no point of the model"),
    ],
)
def test_a_bad_database(tmp_path, change, text):
    model = model_with(tmp_path, *change.split(";"))
    with pytest.raises(MapError, match=text):
        read_map_file(model, "map")
    text = "no database at all, but long enough to look like one" * 30
    (model / "database.db").write_text(text)
    with pytest.raises(MapError, match="file is not a database"):
        read_map_file(model, "map")


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
        ({"points": npy((2**62, 2**62), "<f8", ONE)}, "no readable NumPy archive: cannot reshape"),
        ({"points": npy((1, 3, 10**9, 0), "<f8")}, r"must be \(n,3\) numbers"),
        ({"points": pickled()}, "Object arrays cannot be loaded"),
        ({"ids": npy((1,), "<i8", bytes(8))}, "no array 'points'; found ids"),
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


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("points3D.bin", struct.pack("<Q", 10**12)),
        ("points3D.bin", struct.pack("<Q", 1) + bytes(43) + b"\xff" * 8),
        ("images.bin", struct.pack("<Q", 2**64 - 1) + bytes(80)),
        ("cameras.bin", struct.pack("<QIiQQ", 1, 1, 9999, 640, 480)),
        ("points3D.bin", None),
    ],
)
def test_a_bad_model(tmp_path, name, data):
    """What pycolmap makes of it, an abort or a terabyte, stays in its process."""
    model = tmp_path / "model"
    shutil.copytree(COLMAP / "binary", model)
    (model / name).unlink() if data is None else (model / name).write_bytes(data)
    with pytest.raises(MapError, match="is no model of COLMAP: it needs" if data is None else
                       "pycolmap cannot read it: "):  # fmt: skip
        read_map_file(model, "map")


def test_sizes_that_an_archive_claims_allocate_nothing(tmp_path):
    """An archive of a few bytes that stands for gigabytes: by its header, its list, or packed."""
    one = npy((1, 3), "<f8", ONE)
    listed = archive(tmp_path / "a.npz", points=one)
    data = bytearray(listed.read_bytes())
    struct.pack_into("<I", data, data.index(b"PK\x01\x02") + 24, 2**32 - 2)  # the size unpacked
    listed.write_bytes(data)
    zeros = npy((40_000_000, 3), "|u1", bytes(120_000_000))
    for path, text in (
        (listed, "the arrays are larger than 34 MB"),
        (archive(tmp_path / "b.npz", zipfile.ZIP_DEFLATED, points=zeros), "larger than 36 MB"),
    ):
        tracemalloc.start()
        with pytest.raises(MapError, match=text):
            read_map_file(path, "map")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**20


COUNT = 4
# Of a PointField: 32 bits, unsigned or signed.
IDS = [None, [0, 2**32 - 1, 5, 2**31], [-(2**31), -1, 0, 2**31 - 1]]
LARGEST = np.finfo(np.float32).max


def descriptors(kind: str, width: int) -> Any:
    if kind == "none":
        return None
    values = (200 * np.random.default_rng(width).random((COUNT, width))).astype(kind)
    values[:, 0] = [0, 255, 1, 128] if kind == "uint8" else [LARGEST, -LARGEST, -0.0, 1e-45]
    return values


@pytest.mark.parametrize("ids", IDS)
@pytest.mark.parametrize("kind", ["none", "uint8", "float32"])
@pytest.mark.parametrize("width", [1, 3, 128, 130])
def test_a_map_is_what_it_was_before_it_was_written_or_sent(ids, kind, width, tmp_path):
    points = [[1e8, -1e8, 0.1], [-0.0, 1e-300, 5e-324], [1.0, 2.0, 3.0], [1e8 / 3, 7.0, -1e-8]]
    numbers = None if ids is None else np.array(ids, np.int64)
    landmarks = Map(np.array(points), numbers, descriptors(kind, width), "map")
    write_npz(tmp_path / "a.npz", landmarks)
    assert read_map_file(tmp_path / "a.npz", "map").equals(landmarks)
    message = make_cloud(make_message, 0, "map", map_rows(landmarks))
    if ids is None and kind == "none":
        with pytest.raises(MessageError, match="neither a field id nor descriptor"):
            read_map(message)
    else:
        assert read_map(message).equals(landmarks)
