# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The output ``~/image_rect_shutter``: images as a global shutter would have taken them."""

import threading
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image as ImageMessage

from rs_localizer.config import ShutterDepth
from rs_localizer.core.camera import Camera
from rs_localizer.io.images import COLORS, in_color, read_any_image
from rs_localizer.io.messages import MessageError, make_header, stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import COMPRESSED_IMAGE, IMAGE, IMAGE_RECT_SHUTTER
from rs_localizer.offline.rectified import Depths, FlatError, map_depths, plane_depths, rectified
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import middle_row_ns
from rs_localizer.ros.node.conversion import create_output, make_message
from rs_localizer.ros.node.inputs import Topic

# Images that wait for their frame: a third of a second of a usual camera.
_WAITING = 10
# A warning of the same kind comes so often at most, in s.
_QUIET = 10.0

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """A frame, and the camera as it was known then."""

    frame: Localized
    camera: Camera
    middle_ns: int  # when the middle row was exposed


class ShutterOutput:
    """Publishes the images of localized frames, in a thread of its own: the newest wins.

    An image belongs to the frame with its stamp. What no row has seen is black.

    Args:
        node: creates the publisher.
        frames: has the camera and the settings that hold now.
    """

    def __init__(self, node: LifecycleNode, frames: FrameLocalizer) -> None:
        self._node, self._frames = node, frames
        self._depth = frames.config.image_rect_shutter
        self._publisher = create_output(node, ImageMessage, f"~/{IMAGE_RECT_SHUTTER}")
        self._changed = threading.Condition()
        self._images: dict[int, Any] = {}  # messages by their stamps
        self._solved: dict[int, _Solved] = {}
        self._next: tuple[Any, _Solved] | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="rs_localizer shutter", daemon=True)
        self._thread.start()

    def topics(self) -> dict[str, Topic]:
        """What has to be listened to."""
        kinds = {IMAGE: ImageMessage, COMPRESSED_IMAGE: CompressedImage}
        return {name: Topic(kind, self._take) for name, kind in kinds.items()}

    def add(self, frame: Localized) -> None:
        """Take a localized frame, in the worker's thread."""
        config, calibration = self._frames.config, self._frames.calibration
        assert calibration is not None  # without it no frame is localized
        camera = calibration.camera(config.readout_time, config.scan_direction)
        stamp = frame.input_stamp_ns
        solved = _Solved(frame, camera, middle_row_ns(config, camera, stamp))
        with self._changed:
            _keep(self._solved, stamp, solved)
            self._match(stamp)

    def _take(self, message: Any) -> None:
        if not self._publisher.get_subscription_count():
            return
        with self._changed:
            stamp = stamp_ns(message)
            _keep(self._images, stamp, message)
            self._match(stamp)

    def _match(self, stamp: int) -> None:
        if stamp in self._images and stamp in self._solved:
            self._next = self._images.pop(stamp), self._solved.pop(stamp)
            self._changed.notify()

    def close(self) -> None:
        """End the thread, after the image that it is at."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._node.destroy_lifecycle_publisher(self._publisher)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._next is not None)
                if self._closed:
                    return
                assert self._next is not None
                (message, solved), self._next = self._next, None
            try:
                self._publisher.publish(self._rectified(message, solved))
            except (MessageError, FlatError) as error:
                self._node.get_logger().warning(
                    f"no {IMAGE_RECT_SHUTTER}: {error}", throttle_duration_sec=_QUIET
                )

    def _rectified(self, message: Any, solved: _Solved) -> Any:
        image = read_any_image(message)
        height, width = image.pixels.shape
        if (width, height) != solved.camera.size:
            raise MessageError(
                f"the image is of {width}x{height}, camera_info of "
                f"{solved.camera.size[0]}x{solved.camera.size[1]}"
            )
        pixels, _ = rectified(
            solved.camera, in_color(message, image), solved.frame.estimate, self._depths(solved)
        )
        gray = pixels.ndim == 2
        return make_message(
            "sensor_msgs/msg/Image",
            header=make_header(make_message, solved.middle_ns, image.frame),
            height=height,
            width=width,
            encoding="mono8" if gray else getattr(message, "encoding", COLORS[0]),
            is_bigendian=0,
            step=width * (1 if gray else 3),
            data=np.ascontiguousarray(pixels).ravel(),
        )

    def _depths(self, solved: _Solved) -> Depths | None:
        if self._depth == ShutterDepth.FAR:
            return None
        rows: NDArray[Any] = solved.frame.inliers
        points = np.stack([rows[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
        return plane_depths(points) if self._depth == ShutterDepth.PLANE else map_depths(points)


def _keep(waiting: dict[int, Item], stamp: int, item: Item) -> None:
    """Among those that wait, of which the oldest go."""
    waiting[stamp] = item
    while len(waiting) > _WAITING:
        del waiting[next(iter(waiting))]
