"""Streams of JPEGs are split where the images end, not where bytes look like it."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.lab.video import VideoError, read_video, split_jpegs


def jpegs(count: int) -> list[bytes]:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (24, 32, 3), dtype=np.uint8) for _ in range(count)]
    restarts = [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]
    return [cv2.imencode(".jpg", image, restarts)[1].tobytes() for image in images]


def with_segment(jpeg: bytes, content: bytes) -> bytes:
    """With an application segment, such as that of a thumbnail, after the start marker."""
    return jpeg[:2] + b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content + jpeg[2:]


def test_images_are_the_original_bytes() -> None:
    images = jpegs(5)
    assert list(split_jpegs(b"".join(images))) == images
    assert list(split_jpegs(b"head" + b"\0\xff\0".join(images) + b"tail")) == images


def test_thumbnails_belong_to_their_image() -> None:
    first, second = jpegs(2)
    images = [with_segment(first, second), with_segment(second, b"\xff\xd9\xff\xd8")]
    assert list(split_jpegs(b"".join(images))) == images


def test_progressive_images_have_several_scans() -> None:
    image = np.random.default_rng(1).integers(0, 255, (32, 32, 3), dtype=np.uint8)
    progressive = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert progressive.count(b"\xff\xda") > 1
    assert list(split_jpegs(progressive * 2)) == [progressive] * 2


def test_broken_images_are_left_out() -> None:
    first, second = jpegs(2)
    for cut in (1, 3, 30, len(second) // 2, len(second) - 1):
        assert list(split_jpegs(first + second[:cut])) == [first]
    assert list(split_jpegs(b"")) == []


def test_stream_and_container(tmp_path: Path) -> None:
    images = jpegs(3)
    (tmp_path / "a.mjpeg").write_bytes(b"".join(images))
    read = list(read_video(tmp_path / "a.mjpeg"))
    assert [jpeg for jpeg, _ in read] == images
    assert read[0][1].shape == (24, 32)

    writer = cv2.VideoWriter(
        str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (64, 48)
    )
    for level in (50, 100, 150, 200):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    read = list(read_video(tmp_path / "a.avi"))
    assert [round(float(image.mean()), -1) for _, image in read] == [50, 100, 150, 200]
    assert all(cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0) is not None for jpeg, _ in read)


def test_rows_stay_as_the_sensor_read_them(tmp_path: Path) -> None:
    # Orientation 3 of EXIF: to be shown turned by half.
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03" + bytes(7)
    plain = jpegs(1)[0]
    (tmp_path / "a.mjpeg").write_bytes(with_segment(plain, exif))
    ((_, image),) = read_video(tmp_path / "a.mjpeg")
    np.testing.assert_array_equal(image, cv2.imdecode(np.frombuffer(plain, np.uint8), 0))

    writer = cv2.VideoWriter(
        str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (64, 48)
    )
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:24] = 200
    writer.write(picture)
    writer.release()
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    matrix = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    assert data.count(matrix) == 2  # of the movie, then of its track
    half = struct.pack(">9i", -1 << 16, 0, 0, 0, -1 << 16, 0, 64 << 16, 48 << 16, 1 << 30)
    at = data.rfind(matrix)
    data[at : at + len(half)] = half
    (tmp_path / "a.mp4").write_bytes(data)
    ((_, image),) = read_video(tmp_path / "a.mp4")
    assert image[:20].mean() > 150 > image[28:].mean()


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"absent.avi does not exist"):
        list(read_video(tmp_path / "absent.avi"))
    (tmp_path / "text.avi").write_text("hello")
    with pytest.raises(VideoError, match=r"text.avi holds no image"):
        list(read_video(tmp_path / "text.avi"))
    (tmp_path / "broken.mjpeg").write_bytes(jpegs(1)[0][:-9])
    with pytest.raises(VideoError, match=r"broken.mjpeg holds no image"):
        list(read_video(tmp_path / "broken.mjpeg"))
