# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TF in the node: where the camera is on the robot, and where odometry believes the robot.

tf2_ros is imported when a setting needs it: it is not on PyPI, and all else works without it.
Transforms are taken in the executor's thread. Nobody waits in here for those that are not known
yet: frames are kept until they are, while others are localized.
"""

import contextlib
import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any

from rclpy.node import Node
from rclpy.time import Time

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.io.messages import stamp_ns as stamp_of
from rs_localizer.io.transforms import (
    NotYetError,
    Transform,
    TransformError,
    UnusableTransforms,
    read_transform,
)

# For how long tf2's buffer remembers, in ns: its default.
_MEMORY = 10_000_000_000


def check(config: NodeConfig) -> None:
    """Raise ``ValueError`` if settings need tf2_ros and it is not installed."""
    if what := needed(config):
        import_tf2_ros(what)


def needed(config: NodeConfig) -> str:
    """Return the setting that needs TF, and its value; empty if there is none."""
    if config.base_frame:
        return f"base_frame {config.base_frame!r}"
    if config.of_cameras:
        return f"cameras {', '.join(config.cameras)}"
    return f"publish_tf {config.publish_tf}" if config.publish_tf != PublishTf.NONE else ""


def import_tf2_ros(what: str) -> ModuleType:
    """Import the package that ``what`` needs; ``ValueError`` with advice if it is missing."""
    try:
        return importlib.import_module("tf2_ros")
    except ImportError as error:
        raise ValueError(
            f"{what} needs the Python package tf2_ros, which cannot be imported "
            f"({error}): it comes with ROS 2, sudo apt install ros-jazzy-tf2-ros-py"
        ) from error


class Tf:
    """Transforms from TF (see :class:`rs_localizer.io.transforms.Transforms`).

    :meth:`lookup` and :meth:`moves` may be called from any thread, all else belongs to the
    executor's.

    Args:
        node: listens.
        heard: told of the transforms that have come (geometry_msgs/TransformStamped), and
            whether they are static.
    """

    def __init__(self, node: Node, heard: Callable[[list[Any], bool], None]) -> None:
        self._node = node
        self._heard = heard
        self._buffer: Any = None
        self._errors: Any = None  # tf2_ros
        self._deaf = "TF is not listened to"  # why it is not
        self._unusable = UnusableTransforms()
        self._undo = contextlib.ExitStack()

    def listen(self, what: str) -> None:
        """Listen because this needs it.

        Raises:
            ValueError: without tf2_ros; whoever asks later is told, too.
        """
        if self._buffer is not None:
            return
        try:
            tf2_ros: Any = import_tf2_ros(what)
        except ValueError as error:
            self._deaf = str(error)
            raise
        self._errors, self._buffer, hear = tf2_ros, tf2_ros.Buffer(), self._hear

        class Listener(tf2_ros.TransformListener):  # type: ignore[misc]
            def callback(self, data: Any) -> None:
                super().callback(data)
                hear(data.transforms, False)

            def static_callback(self, data: Any) -> None:
                super().static_callback(data)
                hear(data.transforms, True)

        self._undo.callback(Listener(self._buffer, self._node).unregister)

    def _hear(self, transforms: list[Any], static: bool) -> None:
        for item in transforms:
            self._unusable.read(item)
        self._heard(transforms, static)

    def clear(self) -> None:
        """Forget all but the static transforms: time has jumped."""
        if (buffer := self._buffer) is not None:
            buffer.clear()

    def close(self) -> None:
        """Stop listening; later lookups find nothing."""
        self._buffer = None
        self._undo.close()

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """Return ``target_from_source`` at a time (ns); None: the latest.

        Raises:
            NotYetError: when it is known for earlier times.
            TransformError: when it is not known otherwise.
        """
        return read_transform(self._ask(target, source, stamp_ns).transform)

    def moves(self, target: str, source: str) -> bool:
        """Return True if a part of the transform comes with a time.

        Raises:
            TransformError: when it is not known at all.
        """
        return self.latest(target, source)[0] != 0

    def latest(self, target: str, source: str) -> tuple[int, Transform]:
        """Return the stamp (ns) of the newest ``target_from_source``, and it; 0 if it is static.

        Raises:
            TransformError: when it is not known at all.
        """
        found = self._ask(target, source, None)
        return stamp_of(found), read_transform(found.transform)

    def _ask(self, target: str, source: str, stamp_ns: int | None) -> Any:
        """Ask tf2 for the geometry_msgs/TransformStamped that it has now."""
        buffer = self._buffer
        if buffer is None:
            raise TransformError(self._deaf)
        if stamp_ns is not None and stamp_ns <= 0:  # which would mean the latest
            raise TransformError(f"there are no transforms of the time {stamp_ns * 1e-9:.3f} s")
        try:
            return buffer.lookup_transform(target, source, Time(nanoseconds=stamp_ns or 0))
        except self._errors.TransformException as error:
            text = " ".join(str(error).split())
            if not isinstance(error, self._errors.ExtrapolationException):
                raise TransformError(self._unusable.explain(text)) from error
        with contextlib.suppress(self._errors.TransformException):
            latest_ns = stamp_of(buffer.lookup_transform(target, source, Time()))
            if stamp_ns is not None and latest_ns < stamp_ns:
                raise NotYetError(text)
            if stamp_ns is not None and latest_ns - stamp_ns > _MEMORY:
                # A recording that starts over: tf2 would ignore all that comes from now on.
                buffer.clear()
        raise TransformError(text)
