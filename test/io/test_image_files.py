# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Folders of images of other kinds than JPEG and PNG: read where OpenCV reads them, else named."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rs_localizer.io.image_clock import ImageClock
from rs_localizer.io.image_files import FOREIGN, packed_image
from rs_localizer.io.images import Image, decode
from rs_localizer.io.messages import MessageError
from rs_localizer.offline.image_sources import SourceError, from_files, holds_images, image_files

Pillow = pytest.importorskip("PIL.Image")
GRAY = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8), (9, 9), 3)


def written(path: Path, image: Any = GRAY) -> Path:
    try:
        made = cv2.imwrite(str(path), image)
    except cv2.error:
        made = False
    if not made:
        pytest.skip(f"this OpenCV writes no {path.suffix}")
    return path


@pytest.mark.parametrize(
    ("suffix", "most"),
    [(".webp", 8), (".avif", 8), (".jp2", 8), (".tif", 0), (".TIFF", 0), (".pgm", 0), (".bmp", 0)],
)
def test_what_opencv_reads_is_read(suffix, most, tmp_path):
    written(tmp_path / f"1700000000000000000{suffix}")
    files = image_files(tmp_path)
    (shot,) = from_files(files, None, ImageClock(None))
    assert isinstance(shot.image, Image), shot.image
    assert shot.image.stamp_ns == 1_700_000_000_000_000_000
    off = shot.image.pixels.astype(int) - GRAY
    assert np.abs(off).max() <= most
    # detect --images keeps what the other programs of a bag can read.
    np.testing.assert_array_equal(decode(bytes(shot.compressed.data), "png"), shot.image.pixels)


def test_sixteen_bits_and_colours_stay(tmp_path):
    deep = written(tmp_path / "deep.tiff", GRAY.astype(np.uint16) * 257)
    data, name = packed_image(deep)
    assert name == "png"
    kept = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(kept, GRAY.astype(np.uint16) * 257)
    colours = np.dstack([GRAY, GRAY // 2, 255 - GRAY])
    data, _ = packed_image(written(tmp_path / "colours.ppm", colours))
    kept = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(kept, colours)


@pytest.mark.parametrize("suffix", [".tiff", ".webp"])
def test_rows_are_never_turned_by_a_note(suffix, tmp_path):
    image, path = Pillow.fromarray(GRAY), tmp_path / f"noted{suffix}"
    notes = image.getexif()
    notes[0x0112] = 6  # a quarter turn
    image.save(path, exif=notes, lossless=True)
    if suffix == ".tiff":
        with pytest.raises(MessageError, match=r"\(Orientation 6\).* set it to 1 \(exiftool"):
            packed_image(path)
    else:
        data, _ = packed_image(path)
        assert np.abs(decode(data, "png").astype(int) - GRAY).max() <= 2


@pytest.mark.parametrize("suffix", [".pgm", ".tiff", ".webp"])
def test_a_small_file_of_many_pixels_is_refused_by_its_header(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"bomb{suffix}"
    if suffix == ".pgm":
        path.write_bytes(b"P5 13000 13000 255\n" + bytes(100))
    else:
        Pillow.new("1" if suffix == ".tiff" else "L", (13000, 13000)).save(
            path, **({"compression": "group4"} if suffix == ".tiff" else {"lossless": True})
        )
    assert path.stat().st_size < 400_000
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(MessageError, match="says that it is 13000 x 13000, too"):
        packed_image(path)


@pytest.mark.parametrize("suffix", [".webp", ".tiff", ".pgm", ".bmp"])
def test_a_damaged_file_is_refused_by_its_name(suffix, tmp_path):
    path = written(tmp_path / f"1700000000000000000{suffix}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (shot,) = from_files([path], None, ImageClock(None))
    assert not shot.image
    assert path.name in shot.image.detail


def test_other_numbers_than_of_8_or_16_bits_are_named(tmp_path):
    path = written(tmp_path / "float.tiff", GRAY.astype(np.float32))
    with pytest.raises(MessageError, match="its pixels are float32, not of 8 or 16 bits"):
        packed_image(path)


@pytest.mark.parametrize("suffix", sorted(FOREIGN))
def test_what_is_not_read_is_named_with_a_remedy(suffix, tmp_path):
    for k in range(12):
        (tmp_path / f"IMG_{k:04}{suffix.upper()}").touch()
    with pytest.raises(SourceError) as refused:
        image_files(tmp_path)
    assert f"12 images that cannot be read ({suffix}): convert them to PNG" in str(refused.value)
    assert holds_images(tmp_path) == "is a folder of 12 images"


def test_a_folder_without_any_image_says_what_is_read(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(SourceError, match=r"no file ends in \.jpg, .*\.tiff"):
        image_files(tmp_path)
