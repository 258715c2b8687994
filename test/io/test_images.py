# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of all encodings, and what is wrong with those that cannot be read."""

import array
import struct
import subprocess
import sys
import zlib
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rs_localizer.io.image_clock import ImageClock, readout_fault
from rs_localizer.io.images import read_image
from rs_localizer.io.messages import MessageError

HEADER = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=4), frame_id="camera")


def image(encoding: str, rows: list[bytes], width: int, step: int = 0, big: int = 0) -> Any:
    step = step or max(map(len, rows))
    data = b"".join(row.ljust(step, b"\xaa") for row in rows)
    return SimpleNamespace(
        header=HEADER,
        height=len(rows),
        width=width,
        encoding=encoding,
        is_bigendian=big,
        step=step,
        data=array.array("B", data),
    )


def compressed(data: bytes, name: str = "jpeg") -> Any:
    return SimpleNamespace(header=HEADER, format=name, data=array.array("B", data))


GRAY = np.random.default_rng(0).integers(0, 256, (6, 8), np.uint8)


ROWS = [row.tobytes() for row in GRAY]


def test_gray_with_padded_rows():
    for encoding, step in (("mono8", 8), ("mono8", 11), ("8UC1", 0)):  # 0: left out by some drivers
        message = image(encoding, ROWS, 8, step)
        message.step = step
        found = read_image(message)
        np.testing.assert_array_equal(found.pixels, GRAY)
        assert (found.stamp_ns, found.frame) == (3_000_000_004, "camera")


@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "rgba8", "8UC3", "8UC4"])
def test_color(encoding):
    # ITU-R BT.601, as in every other converter.
    weights = {"r": 0.299, "g": 0.587, "b": 0.114, "a": 0.0}
    order = {"8UC3": "bgr8", "8UC4": "bgra8"}.get(encoding, encoding)[:-1]
    channels = np.random.default_rng(1).integers(0, 256, (4, 5, len(order)), np.uint8)
    found = read_image(image(encoding, [row.tobytes() for row in channels], 5, step=32))
    expected = channels @ np.array([weights[c] for c in order])
    np.testing.assert_allclose(found.pixels, expected, atol=0.51)


@pytest.mark.parametrize(("encoding", "big"), [("mono16", 0), ("16UC1", 1), ("bgr16", 1)])
@pytest.mark.parametrize(("bits", "shift"), [(16, 8), (12, 4), (8, 0)])
def test_sixteen_bits(encoding, big, bits, shift):
    values = np.array([[0, 2**bits - 1], [2**bits // 3, 2**bits // 2]])
    count = 3 if encoding == "bgr16" else 1
    rows = [
        struct.pack((">" if big else "<") + f"{2 * count}H", *np.repeat(r, count)) for r in values
    ]
    found = read_image(image(encoding, rows, 2, big=big))
    np.testing.assert_allclose(found.pixels, values >> shift, atol=1)


def test_sixteen_bits_keep_their_contrast():
    """A thermal image of 200 values around 7000, with a pixel that is always bright."""
    values = 6900 + 2 * np.arange(100 * 100).reshape(100, 100) // 100
    rows = values.astype("<u2")
    rows[3, 4] = 65535
    found = read_image(image("mono16", [row.tobytes() for row in rows], 100)).pixels
    assert found[-1, 0] - int(found[0, 0]) > 190
    assert np.all(np.diff(found[10:90, 0].astype(int)) >= 0)
    assert found[3, 4] == 255


@pytest.mark.parametrize(
    ("order", "bits"), [("rggb", 8), ("bggr", 8), ("gbrg", 8), ("grbg", 8), ("rggb", 16)]
)
def test_bayer(order, bits):
    # An evenly colored wall: every pixel is the same gray.
    color = {"r": 255, "g": 100, "b": 40}
    pattern = np.array([color[c] for c in order]).reshape(2, 2)
    mosaic = np.tile(pattern, (8, 8)) << (bits - 8)
    rows = [row.astype(f"<u{bits // 8}").tobytes() for row in mosaic]
    found = read_image(image(f"bayer_{order}{bits}", rows, 16))
    expected = 0.299 * 255 + 0.587 * 100 + 0.114 * 40
    np.testing.assert_allclose(found.pixels[2:-2, 2:-2], expected, atol=1.5)


@pytest.mark.parametrize(
    ("encoding", "bytes_", "place", "after"),
    [
        ("yuv422", 2, 1, 0), ("uyvy", 2, 1, 0), ("yuv422_yuy2", 2, 0, 0), ("yuyv", 2, 0, 0),
        ("nv12", 1, 0, 3), ("nv21", 1, 0, 3), ("yuv420", 1, 0, 3), ("nv24", 1, 0, 12),
    ],
)  # fmt: skip
def test_brightness_beside_colour(encoding, bytes_, place, after):
    """Within each pixel, or in the first plane, which rows of colour follow."""
    data = np.full((6 + after, 8, bytes_), 128, np.uint8)
    data[:6, :, place] = GRAY
    rows = [row.tobytes() for row in data]
    message = image(encoding, rows, 8, 8 * bytes_ + 3)
    message.height = 6
    np.testing.assert_array_equal(read_image(message).pixels, GRAY)
    message = image(encoding, rows[: 7 if after else 5], 8)
    message.height = 6
    with pytest.raises(MessageError, match="the data are truncated"):
        read_image(message)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"encoding": "32FC1"}, "the encoding '32FC1' is not supported; supported are mono8"),
        ({"width": 0}, "the image has no pixels: width 0, height 6"),
        ({"step": 7}, "step is 7, too small for 8 pixels of mono8: 8 bytes"),
        ({"height": 7}, "truncated: 8 x 7 pixels of mono8 take 56 bytes, found 48"),
        ({"height": 2**32 - 1, "width": 2**32 - 1, "step": 2**32 - 1},
         "take 18446744065119617025 bytes, found 48"),
    ],
)  # fmt: skip
def test_bad_images(changes, text):
    message = image("mono8", ROWS, 8)
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match=text):
        read_image(message)


SMOOTH = np.add.outer(np.arange(0, 120, 2), np.arange(0, 80)).astype(np.uint8)
JPEG = cv2.imencode(".jpg", SMOOTH)[1].tobytes()
PNG = cv2.imencode(".png", SMOOTH)[1].tobytes()


def test_jpeg_and_png():
    np.testing.assert_array_equal(read_image(compressed(PNG, "png")).pixels, SMOOTH)
    found = read_image(compressed(JPEG, "mono8; jpeg compressed mono8"))
    np.testing.assert_allclose(found.pixels, SMOOTH, atol=6)
    padded = read_image(compressed(JPEG + bytes(500)))  # of drivers that send a buffer
    np.testing.assert_array_equal(padded.pixels, found.pixels)
    deep = SMOOTH.astype(np.uint16) << 4
    deep_png = cv2.imencode(".png", deep)[1].tobytes()
    np.testing.assert_array_equal(read_image(compressed(deep_png)).pixels, SMOOTH)
    color = cv2.imencode(".png", np.dstack([SMOOTH] * 3))[1].tobytes()
    np.testing.assert_allclose(read_image(compressed(color)).pixels, SMOOTH, atol=1)


@pytest.mark.parametrize(
    ("data", "name", "text"),
    [
        (b"", "jpeg", "neither JPEG nor PNG: its format is 'jpeg' and its 0 bytes start with noth"),
        (JPEG[: len(JPEG) // 2], "jpeg", "the JPEG image is truncated: its .* no end mark"),
        (PNG[: len(PNG) // 2], "png", "the PNG image is truncated"),
        (b"\xff\xd8\xff\xd9", "jpeg", "the JPEG image of 4 bytes cannot be decoded"),
        (JPEG[:2] + b"junk" + JPEG[2:], "jpeg", "cannot be decoded: no header has its size"),
    ],
)
def test_bad_compressed_images(data, name, text):
    with pytest.raises(MessageError, match=text):
        read_image(compressed(data, name))


def chunk(kind: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4) + kind + body + zlib.crc32(kind + body).to_bytes(4)


def test_an_animated_png_is_read_as_its_still_image():
    """OpenCV 5.0 ends the process by SIGSEGV; hence a process of its own."""
    rows = chunk(b"IDAT", zlib.compress((b"\0" + bytes(range(16))) * 12))
    control = struct.pack(">5I2H2B", 2, 8, 6, 3, 3, 1, 10, 0, 0)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 12, 8, 0, 0, 0, 0))
    animated = PNG[:8] + header + chunk(b"acTL", struct.pack(">II", 3, 0))
    animated += rows + chunk(b"fcTL", control) + rows + chunk(b"IEND", b"")
    program = (
        "import sys; from types import SimpleNamespace as N\n"
        "from rs_localizer.io.images import read_image\n"
        "header = N(stamp=N(sec=0, nanosec=0), frame_id='camera')\n"
        "data = sys.stdin.buffer.read()\n"
        "print(read_image(N(header=header, format='png', data=data)).pixels.shape)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], input=animated, capture_output=True)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.split() == [b"(12,", b"16)"]


# ns of a phone that leaves images out: 10 images/s on average.
OWN = [ms * 1_000_000 for ms in (0, 33, 67, 100, 300)]


@pytest.mark.parametrize(
    ("rate", "stamps", "described", "fault"),
    [
        (None, OWN, "presentation times of the video, 13.33 images/s on average", None),
        (30.0, [round(k * 1e9 / 30) for k in range(5)], "times: --rate 30; the first image at 1 s",
         "30 disagrees with the file, whose own times mean 13.33 images/s"),
        (13.34, [round(k * 1e9 / 13.34) for k in range(5)], "--rate 13.34", None),
    ],
)  # fmt: skip
def test_times_of_a_video_begin_at_one_second(rate, stamps, described, fault):
    clock = ImageClock(rate)
    assert [clock.stamp(own) for own in OWN] == [10**9 + stamp for stamp in stamps]
    assert described in clock.description()
    assert (clock.stamp(None) is None) == (rate is None)
    assert clock.fault() is None if fault is None else fault in clock.fault()


def test_times_of_names_and_none():
    clock = ImageClock(absolute=True)
    assert [clock.stamp(10**18 + k) for k in (0, 7)] == [10**18, 10**18 + 7]
    assert "the names of the files" in clock.description()
    clock = ImageClock(rate=30.0)
    assert (clock.stamp(None), clock.fault()) == (10**9, None)
    clock = ImageClock()
    clock.stamp(0)  # the first of some files has a time, always
    for without in (ImageClock(), clock):
        with pytest.raises(ValueError, match="give --rate"):
            without.stamp(None)


def test_a_readout_longer_than_a_period():
    assert readout_fault(0.03, 0.033) is None
    assert readout_fault(0.03, np.nan) is None
    assert "50 ms is longer than the 33 ms from image" in readout_fault(0.05, 0.033)
