# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Streams of JPEGs are split where the images end, not where bytes look like it."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.io.video import Video, has_times, split_jpegs


def jpegs(count: int) -> list[bytes]:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (24, 32, 3), dtype=np.uint8) for _ in range(count)]
    restarts = [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]
    return [cv2.imencode(".jpg", image, restarts)[1].tobytes() for image in images]


def film(path: Path, images: list[np.ndarray], code: str = "mp4v", rate: float = 30.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), rate, (64, 48))
    for image in images:
        writer.write(image)
    writer.release()
    return path


def test_images_are_the_original_bytes():
    images = jpegs(5)
    assert list(split_jpegs(b"".join(images))) == images
    assert list(split_jpegs(b"head" + b"\0\xff\0".join(images) + b"tail")) == images


def test_broken_images_are_left_out():
    first, second = jpegs(2)
    for cut in (1, 3, 30, len(second) // 2, len(second) - 1):
        assert list(split_jpegs(first + second[:cut])) == [first]
    assert list(split_jpegs(b"")) == []


def test_stream_and_container(tmp_path):
    images = jpegs(3)
    (tmp_path / "a.mjpeg").write_bytes(b"".join(images))
    read = list(Video(tmp_path / "a.mjpeg"))
    assert [jpeg for jpeg, *_ in read] == images
    assert {item.seconds for item in read} == {None}
    assert read[0][1].shape == (24, 32)

    levels = [np.full((48, 64, 3), level, np.uint8) for level in (50, 100, 150, 200)]
    read = list(Video(film(tmp_path / "a.avi", levels, "MJPG")))
    assert [round(float(image.mean()), -1) for _, image, _ in read] == [50, 100, 150, 200]
    assert all(cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0) is not None for jpeg, *_ in read)


def test_rows_stay_as_the_sensor_read_them(tmp_path):
    # Orientation 3 of EXIF: to be shown turned by half.
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03" + bytes(7)
    plain = jpegs(1)[0]
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "a.mjpeg").write_bytes(plain[:2] + segment + plain[2:])
    ((_, image, _),) = Video(tmp_path / "a.mjpeg")
    np.testing.assert_array_equal(image, cv2.imdecode(np.frombuffer(plain, np.uint8), 0))

    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:24] = 200
    data = bytearray(film(tmp_path / "a.mp4", [picture]).read_bytes())
    matrix = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    assert data.count(matrix) == 2  # of the movie, then of its track
    half = struct.pack(">9i", -1 << 16, 0, 0, 0, -1 << 16, 0, 64 << 16, 48 << 16, 1 << 30)
    at = data.rfind(matrix)
    data[at : at + len(half)] = half
    (tmp_path / "a.mp4").write_bytes(data)
    ((_, image, _),) = Video(tmp_path / "a.mp4")
    assert image[:20].mean() > 150 > image[28:].mean()


def mp4(path: Path, milliseconds: list[int]) -> None:
    """A video of grey levels 40, 50, 60 ... whose images last so long; by OpenCV and by hand.

    OpenCV writes a constant rate. The table of durations (ISO/IEC 14496-12, ``stts``) is replaced,
    and the sizes of the boxes around it are mended.
    """
    levels = [np.full((48, 64, 3), 40 + 10 * k, np.uint8) for k in range(len(milliseconds))]
    data = film(path, levels, rate=1000.0).read_bytes()
    at = data.index(b"stts") - 4
    size, _, count = struct.unpack_from(">I4xII", data, at)
    (unit,) = struct.unpack_from(">I", data, at + 20)  # of a millisecond
    assert count == 1
    table = b"".join(struct.pack(">II", 1, unit * duration) for duration in milliseconds)
    box = struct.pack(">I4sII", 16 + len(table), b"stts", 0, len(milliseconds)) + table
    larger = bytearray(data[:at] + box + data[at + size :])
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        place = data.index(name) - 4
        (before,) = struct.unpack_from(">I", data, place)
        struct.pack_into(">I", larger, place, before + len(table) - 8)
    # The edit list says in ms how long the whole is shown.
    struct.pack_into(">I", larger, data.index(b"elst") + 12, sum(milliseconds))
    assert data.index(b"mdat") < at, "the images would have moved"
    path.write_bytes(larger)


def test_images_of_a_variable_rate_have_their_presentation_times(tmp_path):
    # A dropped image, a pause, two quick ones.
    milliseconds = [33, 33, 67, 33, 10, 500, 33, 33]
    mp4(tmp_path / "a.mp4", milliseconds)
    read = list(Video(tmp_path / "a.mp4"))
    expected = np.concatenate([[0], np.cumsum(milliseconds)[:-1]]) * 1e-3
    assert [item.seconds for item in read] == pytest.approx(list(expected), abs=1e-6)
    # Each time is that of its own image.
    assert [round(float(item.image.mean()), -1) for item in read] == [*range(40, 120, 10)]
    assert has_times(tmp_path / "a.mp4")
    (tmp_path / "a.mjpeg").write_bytes(b"".join(jpegs(2)))
    assert not has_times(tmp_path / "a.mjpeg")


def test_an_image_whose_time_is_not_told_has_none(monkeypatch, tmp_path):
    """As OpenCV 4.6 does with the last images of a video with B frames: it says 0."""
    mp4(tmp_path / "a.mp4", [33, 33, 33])

    class Forgetful:
        def __init__(self, name: str) -> None:
            self.video, self.count = real(name), 0
            self.set, self.release = self.video.set, self.video.release

        def read(self) -> object:
            self.count += 1
            return self.video.read()

        def get(self, what: int) -> float:
            return 0.0 if self.count == 3 else float(self.video.get(what))

    real = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", Forgetful)
    times = [item.seconds for item in Video(tmp_path / "a.mp4")]
    assert times == [0.0, pytest.approx(0.033), None]
