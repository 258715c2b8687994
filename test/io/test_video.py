# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of videos, with the times of their presentation, as far as a file is whole."""

import re
import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.io.image_clock import ImageClock
from rs_localizer.io.video import Video, has_times
from rs_localizer.offline.image_sources import from_video

av = pytest.importorskip("av", reason="needs PyAV (rs_localizer[video])")


def jpegs(count: int) -> list[bytes]:
    levels = [np.full((48, 64, 3), 60 + 20 * k, np.uint8) for k in range(count)]
    for image in levels:
        image[:24] += 80
    return [cv2.imencode(".jpg", image)[1].tobytes() for image in levels]


def film(path: Path, images: list[np.ndarray], code: str = "mp4v", rate: float = 30.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), rate, (64, 48))
    for image in images:
        writer.write(image)
    writer.release()
    return path


def test_stream_and_container(tmp_path):
    (tmp_path / "a.mjpeg").write_bytes(b"".join(jpegs(3)))
    read = list(Video(tmp_path / "a.mjpeg"))
    assert [item.seconds for item in read] == [None] * 3
    assert read[0].image.shape == (48, 64)

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
    assert image[:20].mean() > 130 > image[28:].mean()

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


def muxed(
    path: Path, times: Sequence[int] = range(0, 1200, 100), options: dict[str, str] | None = None
) -> Path:
    """Images at times in ms, of grey levels 40, 50 ..."""
    with av.open(str(path), "w", options=options) as container:
        film = container.add_stream("mpeg4", rate=1000)
        film.width, film.height, film.pix_fmt = 64, 48, "yuv420p"
        for k, time in enumerate(times):
            level = np.full((48, 64), min(40 + 10 * k, 200), np.uint8)
            frame = av.VideoFrame.from_ndarray(level, format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(film.encode(frame))
        container.mux(film.encode(None))
    return path


def test_images_of_a_variable_rate_have_their_presentation_times(tmp_path):
    # A dropped image, a pause, two quick ones.
    milliseconds = [0, 33, 66, 133, 166, 176, 676, 709]
    read = list(Video(muxed(tmp_path / "a.mp4", milliseconds)))
    assert [item.seconds for item in read] == pytest.approx([1e-3 * t for t in milliseconds])
    # Each time is that of its own image.
    assert [round(float(item.image.mean()), -1) for item in read] == [*range(40, 120, 10)]
    assert has_times(tmp_path / "a.mp4")
    (tmp_path / "a.mjpeg").write_bytes(b"".join(jpegs(2)))
    assert not has_times(tmp_path / "a.mjpeg")


@pytest.mark.parametrize(
    ("captured", "rate", "said"),
    [("80.000000", None, "80 images/s, as the file notes, and its times mean 10: in slow"),
     ("80.000000", None, "velocities are 8 times too small; --rate 80 gives true times"),
     ("2", None, "are 5 times too large"), ("80", 80.0, None), ("10", None, None),
     ("12", None, None), ("ten", None, None), (None, None, None)],
)  # fmt: skip
def test_slow_motion_is_said_with_both_rates(tmp_path, captured, rate, said):
    path, notes = muxed(tmp_path / "a.mp4"), {}
    if captured is not None:
        notes["com.android.capture.fps"] = captured
    noted(path, tmp_path / "noted.mp4", notes)
    clock = ImageClock(rate)
    list(from_video(tmp_path / "noted.mp4", None, clock))
    text = clock.slow_motion()
    assert (text is None) if said is None else (said in text)
    # Who gives the rate of the camera is right.
    assert clock.fault() is None


def noted(path: Path, out: Path, notes: dict[str, str]) -> None:
    """The same video with notes, as phones write them."""
    options = {"movflags": "use_metadata_tags"}
    with av.open(str(path)) as given, av.open(str(out), "w", options=options) as made:
        made.metadata.update(notes)
        stream = made.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(given.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                made.mux(packet)


def test_images_that_cannot_be_decoded_are_counted(tmp_path):
    data = bytearray(muxed(tmp_path / "a.mp4").read_bytes())
    start = data.index(b"mdat")
    middle = start + (data.index(b"moov") - start) // 2
    data[middle : middle + 200] = bytes(200)
    (tmp_path / "a.mp4").write_bytes(data)
    found = Video(tmp_path / "a.mp4")
    list(found)
    assert "a.mp4 has " in str(found.fault)
    assert "images that cannot be decoded: it is damaged or cut off" in str(found.fault)


@pytest.mark.parametrize(("suffix", "options"), [("mp4", {"movflags": "faststart"}), ("mkv", {})])
def test_half_of_a_file_says_so(tmp_path, suffix, options):
    """Its header, at its front, is whole: so are copies that broke off."""
    whole = Video(muxed(tmp_path / f"a.{suffix}", range(0, 8000, 100), options))
    assert len(list(whole)) == 80
    assert whole.fault is None
    half = tmp_path / f"half.{suffix}"
    half.write_bytes(whole.path.read_bytes()[: whole.path.stat().st_size // 2])
    found = Video(half)
    assert 0 < len(list(found)) < 60
    assert re.fullmatch(r"half.m.. (lasts|has) .*: it is damaged or cut off", str(found.fault))


def test_images_that_begin_late_have_the_clock_of_the_file(tmp_path):
    """As a video has that was cut without encoding it anew."""
    path = muxed(tmp_path / "late.mp4", range(854, 2054, 100))
    times = [item.seconds for item in Video(path)]
    assert times == pytest.approx([0.854 + 0.1 * k for k in range(12)], abs=1e-6)
    clock = ImageClock()
    stamps = [clock.stamp(round(1e9 * seconds)) for seconds in times]
    assert stamps[0] == pytest.approx(1_854_000_000, abs=10)
    assert "the first image at 1.854 s" in clock.description()
