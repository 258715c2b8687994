# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos in recordings, a packet in each message: of Foxglove and of ffmpeg_image_transport.

An image depends on packets before its own, and a decoder may hold it back until later ones: which
message it is of, the number tells that its packet was given as its time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rs_localizer.io.messages import MessageError

if TYPE_CHECKING:  # OpenCV and PyAV are loaded by those who decode
    from rs_localizer.io.video import VideoImage

FOXGLOVE_TYPE = "foxglove_msgs/msg/CompressedVideo"
FFMPEG_TYPE = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
PACKET_TYPES = (FOXGLOVE_TYPE, FFMPEG_TYPE)
DEFINITIONS = {
    FOXGLOVE_TYPE: (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    ),
    FFMPEG_TYPE: (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n"
        "uint8 flags\nbool is_bigendian\nuint8[] data"
    ),
}
"""Message types, for recordings of ROS 2 before Iron, which do not describe their types."""

# Parts of names of encoders and formats (libx264, h264_nvenc, "hevc;yuv420p;..."): the decoder.
_DECODERS = {
    "264": "h264", "265": "hevc", "hevc": "hevc", "av1": "libdav1d", "vp9": "vp9", "vp8": "vp8",
    "mpeg4": "mpeg4", "mjpeg": "mjpeg",
}  # fmt: skip
# H.264 holds back 16 images at most; a packet without an image for longer has none.
_MOST_HELD_BACK = 32


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """The stamp and frame of a packet of video, without its data."""

    stamp_ns: int
    frame: str  # the camera's optical frame, or what the message says of it
    beside: Any  # what the caller wants to have again with the image


class PacketDecoder:
    """Decodes the messages of one topic, in their order."""

    def __init__(self) -> None:
        self._context: Any = None
        self._name, self._count = "", 0
        self._open: dict[int, Packet] = {}  # without an image so far, by their numbers

    def decode(self, message: Any, beside: Any) -> Iterator[tuple[Packet, VideoImage | str]]:
        """Yield the images that this packet completes, or why an earlier one has none.

        Raises:
            MessageError: for what no decoder is known for.
            ImportError: without PyAV.
        """
        import av

        from rs_localizer.io.images import MOST_PIXELS

        name = _decoder(str(getattr(message, "format", None) or message.encoding))
        if name != self._name:
            yield from self.rest()
            self._context, self._name = av.CodecContext.create(name, "r"), name
            self._context.options = {"max_pixels": str(MOST_PIXELS)}
        stamp = message.timestamp if hasattr(message, "timestamp") else message.header.stamp
        frame = message.frame_id if hasattr(message, "frame_id") else message.header.frame_id
        packet = av.Packet(bytes(message.data))
        packet.pts = packet.dts = self._count
        stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
        self._open[self._count] = Packet(stamp_ns, str(frame), beside)
        self._count += 1
        yield from self._images(packet)
        while self._open and min(self._open) < self._count - _MOST_HELD_BACK:
            yield self._open.pop(min(self._open)), _LOST

    def rest(self) -> Iterator[tuple[Packet, VideoImage | str]]:
        """Yield the images that have been held back, and the packets that have none."""
        if self._context is not None:
            yield from self._images(None)
        for number in sorted(self._open):
            yield self._open.pop(number), _LOST

    def _images(self, packet: Any) -> Iterator[tuple[Packet, VideoImage]]:
        import av

        from rs_localizer.io.video import compress

        try:
            frames = self._context.decode(packet)
        except av.FFmpegError:  # damaged, or before the first key image: nothing comes of it
            return
        for frame in frames:
            if frame.pts in self._open:
                yield self._open.pop(frame.pts), compress(frame.to_ndarray(format="bgr24"), None)


_LOST = "no image can be decoded from its packet: damaged, or before the first key image"


def _decoder(said: str) -> str:
    for part, name in _DECODERS.items():
        if part in said.lower():
            return name
    raise MessageError(
        f"the video is encoded as {said!r}; known are H.264, H.265, AV1, VP8, VP9, MPEG-4 and MJPEG"
    )
