# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos in bags, a packet a message: every image comes with the stamp of its own message."""

import importlib.util
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rs_localizer.cli.commands import main
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.images import Image, decode
from rs_localizer.io.messages import MessageError
from rs_localizer.io.video_packets import FFMPEG_TYPE, FOXGLOVE_TYPE, PacketDecoder
from rs_localizer.offline.image_sources import SourceError, find_images, from_bag, image_topics

av = pytest.importorskip("av")
WIDTH, HEIGHT, STEP_NS, FIRST_NS = 64, 48, 100_000_000, 1_700_000_000_000_000_000
# Each image has a brightness of its own: which one it is shows without its stamp.
LEVELS = np.linspace(40, 200, 12).round().astype(int)


def encoded(**options: str) -> list[tuple[int, bytes]]:
    """Number of the image and data of each packet of H.264, in the order in which they come."""
    try:
        encoder = av.CodecContext.create("libx264", "w")
    except av.FFmpegError:
        pytest.skip("this PyAV has no encoder of H.264")
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    encoder.time_base, encoder.options = Fraction(1, 10), {"crf": "8"} | options
    packets = []
    for k, level in enumerate([*LEVELS, None]):
        frame = None
        if level is not None:
            image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = k
        packets += [(packet.pts, bytes(packet)) for packet in encoder.encode(frame)]
    return packets


PLAIN = {"tune": "zerolatency"}


def message(kind: str, number: int, data: bytes, encoding: str = "h264") -> Any:
    stamp_ns = FIRST_NS + number * STEP_NS
    stamp = make_message(
        "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
    )
    content = np.frombuffer(data, np.uint8)
    if kind == FOXGLOVE_TYPE:
        return make_message(kind, timestamp=stamp, frame_id="eye", data=content, format=encoding)
    header = make_message("std_msgs/msg/Header", stamp=stamp, frame_id="eye")
    return make_message(
        kind, header=header, width=WIDTH, height=HEIGHT, encoding=encoding, pts=number, flags=0,
        is_bigendian=False, data=content,
    )  # fmt: skip


def bag_of(path: Path, kind: str, packets: list[tuple[int, bytes]], encoding: str = "h264") -> Path:
    with BagWriter(path) as bag:
        for at, (number, data) in enumerate(packets):
            bag.write("/eye/video", message(kind, number, data, encoding), FIRST_NS + at * STEP_NS)
    return path


def number_of(pixels: Any) -> int:
    return int(np.argmin(np.abs(LEVELS - np.median(pixels))))


@pytest.mark.parametrize(
    ("kind", "encoding", "options"),
    [
        (FOXGLOVE_TYPE, "h264", PLAIN),
        (FFMPEG_TYPE, "libx264", PLAIN),
        (FFMPEG_TYPE, "h264;yuv420p;bgr8;bgr8", {"bf": "3"}),  # images are held back
    ],
)
def test_each_image_has_the_stamp_of_its_message(kind, encoding, options, tmp_path):
    packets = encoded(**options)
    if "bf" in options:
        assert [number for number, _ in packets] != list(range(12))
    with open_bag(bag_of(tmp_path / "bag", kind, packets, encoding)) as bag:
        assert image_topics(bag) == ["/eye/video"]
        shots = list(from_bag(bag, find_images(bag, None), None, None))
    assert len(shots) == 12
    for shot in shots:
        assert isinstance(shot.image, Image), shot.image
        number, rest = divmod(shot.image.stamp_ns - FIRST_NS, STEP_NS)
        assert (number_of(shot.image.pixels), rest) == (number, 0)
        assert shot.image.frame == "eye"
        assert number_of(decode(bytes(shot.compressed.data), "jpeg")) == number


def test_packets_before_the_first_key_image_are_refused(tmp_path):
    packets = encoded(**PLAIN, g="6", keyint_min="6")
    with open_bag(bag_of(tmp_path / "bag", FOXGLOVE_TYPE, packets[2:])) as bag:
        shots = list(from_bag(bag, "/eye/video", None, None))
    good = [shot.image for shot in shots if shot.image]
    lost = [shot.image for shot in shots if not shot.image]
    assert len(good) + len(lost) == 10
    for image in good:
        assert number_of(image.pixels) == (image.stamp_ns - FIRST_NS) // STEP_NS
    assert {number_of(image.pixels) for image in good} >= set(range(6, 12))
    assert all("before the first key image" in image.detail for image in lost)


def test_an_unknown_encoding_is_named():
    with pytest.raises(MessageError, match=r"encoded as 'theora'; known are H\.264"):
        list(PacketDecoder().decode(message(FOXGLOVE_TYPE, 0, b"1234", "theora"), None))


def test_without_pyav_the_topic_is_named_with_the_remedy(tmp_path, monkeypatch):
    path = bag_of(tmp_path / "bag", FOXGLOVE_TYPE, [(0, b"1234")])
    monkeypatch.setattr(
        "rs_localizer.offline.image_sources.find_spec",
        lambda name: None if name == "av" else importlib.util.find_spec(name),
    )
    with open_bag(path) as bag, pytest.raises(SourceError, match=r"/eye/video .*pip install av"):
        find_images(bag, None)


def test_other_topics_are_named_where_none_has_images(tmp_path, capsys):
    path = tmp_path / "bag"
    text = make_message("std_msgs/msg/String", data="")
    with BagWriter(path) as bag:
        bag.write("/eye/theora", text, FIRST_NS)
    assert main(["detect", str(path), "--board", "9x6", "--square", "0.03", "--out", "x"]) == 1
    assert "it has /eye/theora (std_msgs/msg/String)" in capsys.readouterr().err
