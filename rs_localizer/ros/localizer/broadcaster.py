"""Sends what ``publish_tf`` asks for, and no pose waits for it."""

from __future__ import annotations

import functools
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.core.reasons import Notice
from rs_localizer.io.outputs import Localized
from rs_localizer.io.transforms import NotYetError, TransformError, make_transform
from rs_localizer.pipeline.broadcasts import Broadcast, broadcast
from rs_localizer.ros.localizer.transforms import Tf, import_tf2_ros, needed
from rs_localizer.ros.node.conversion import make_message
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import WINDOW

# Frames that wait for odometry, which mostly comes later than they do.
_MOST_PENDING = 100


@dataclass(frozen=True, slots=True)
class _Pending:
    """A frame whose transform is to be sent."""

    frame: Localized
    config: NodeConfig
    deadline: float  # time.monotonic()


class Broadcaster:
    """TF's side of the outputs.

    :meth:`publish` may be called from any thread; transforms are heard in one of their own, and all
    else belongs to the executor's.

    Args:
        node: sends, and listens for the odometry.
        refusals: told of what was not sent, and of errors that nobody foresaw.
    """

    def __init__(self, node: Node, refusals: Refusals) -> None:
        self.tf = Tf(node, self._hear, functools.partial(refusals.add, "internal_error"))
        self._node = node
        self._refusals = refusals
        self._broadcaster: Any = None
        self._pending: deque[_Pending] = deque(maxlen=_MOST_PENDING)
        self._sending = threading.Lock()
        self._own: set[tuple[str, str]] = set()  # parents and children that we have sent
        self._parents: dict[str, str] = {}  # that others have sent, by child
        self._sent = 0.0  # when, time.monotonic()
        self._failed: tuple[float, str] | None = None

    def configure(self, config: NodeConfig) -> None:
        """Have what these settings need.

        Raises:
            ValueError: without tf2_ros.
        """
        self.tf.configure(config)
        if config.publish_tf != PublishTf.NONE and self._broadcaster is None:
            self._broadcaster = import_tf2_ros(needed(config)).TransformBroadcaster(self._node)

    def forget(self) -> None:
        """Send nothing of the frames so far."""
        with self._sending:
            self._pending.clear()
            self._failed = None

    def fault(self) -> dict[str, str]:
        """For the diagnostics: why nothing has been sent lately, if something should have been."""
        failed = self._failed
        since = time.monotonic() - WINDOW
        if failed is None or failed[0] < since or self._sent >= since:
            return {}
        return {Notice.NOT_BROADCAST: failed[1]}

    def close(self) -> None:
        self.forget()
        self.tf.close()
        if self._broadcaster is not None:
            self._node.destroy_publisher(self._broadcaster.pub_tf)
            self._broadcaster = None

    def publish(self, frame: Localized, config: NodeConfig) -> None:
        """Send the frame's transform: now, or when odometry has come so far.

        After ``transform_tolerance`` it is given up.
        """
        if config.publish_tf == PublishTf.NONE:
            return
        deadline = time.monotonic() + config.transform_tolerance
        with self._sending:
            self._pending.append(_Pending(frame, config, deadline))
        self._flush()

    def _hear(self, transforms: list[Any]) -> None:
        for item in transforms:
            parent = item.header.frame_id.removeprefix("/")
            child = item.child_frame_id.removeprefix("/")
            if (parent, child) not in self._own:
                self._parents[child] = parent
        self._flush()

    def _flush(self) -> None:
        with self._sending:
            waiting = list(self._pending)
            self._pending.clear()
            for item in waiting:
                try:
                    self._send(broadcast(item.frame, item.config, self.tf))
                except NotYetError as error:
                    if time.monotonic() < item.deadline:
                        self._pending.append(item)
                    else:
                        self._say(item, error)
                except TransformError as error:
                    self._say(item, error)

    def _say(self, item: _Pending, error: TransformError) -> None:
        text = f"publish_tf {item.config.publish_tf}: {error}"
        self._failed = time.monotonic(), text
        self._refusals.notice(Notice.NOT_BROADCAST, text)

    def _send(self, item: Broadcast | None) -> None:
        if item is None or self._broadcaster is None:
            return
        other = self._parents.get(item.child, item.parent)
        if other != item.parent:
            raise TransformError(
                f"frame {item.child!r} hangs on {other!r} already and can have one parent only; "
                "choose publish_tf map_to_odom, or the root of the camera's frames as base_frame"
            )
        self._own.add((item.parent, item.child))
        self._broadcaster.sendTransform(
            make_transform(
                make_message, item.stamp_ns, item.parent, item.child, item.parent_from_child
            )
        )
        self._sent = time.monotonic()
