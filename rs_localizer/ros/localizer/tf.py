# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TF in the node: where the camera is on the robot, and where odometry believes the robot.

tf2_ros is imported when a setting needs it: it is not on PyPI, and all else works without it.
Transforms are taken in the executor's thread. Nobody waits in here for those that are not known
yet: frames are kept until they are, while others are localized.
"""

import contextlib
import importlib
import threading
import time
from collections import deque
from collections.abc import Callable
from types import ModuleType
from typing import Any

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.core.reasons import Notice
from rs_localizer.io.messages import stamp_ns as stamp_of
from rs_localizer.io.outputs import Localized
from rs_localizer.io.transforms import (
    NotYetError,
    Transform,
    TransformError,
    UnusableTransforms,
    make_transform,
    read_transform,
)
from rs_localizer.pipeline.map_to_odom import Holding, MapToOdom
from rs_localizer.pipeline.published import Broadcast, broadcast, check_time
from rs_localizer.ros.node.conversion import make_message, steady_timer
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import WINDOW

# For how long tf2's buffer remembers, in ns: its default.
_MEMORY = 10_000_000_000


def check(config: NodeConfig) -> None:
    """Raise ``ValueError`` if settings need tf2_ros and it is not installed."""
    if what := needed(config):
        import_tf2_ros(what)


def needed(config: NodeConfig) -> str:
    """The setting that needs TF, and its value; empty if there is none."""
    if config.base_frame:
        return f"base_frame {config.base_frame!r}"
    if config.of_cameras:
        return f"cameras {', '.join(config.cameras)}"
    return f"publish_tf {config.publish_tf}" if config.publish_tf != PublishTf.NONE else ""


def import_tf2_ros(what: str) -> ModuleType:
    """The package, which ``what`` needs; ``ValueError`` with what to do where it is missing."""
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
        heard: told of the transforms that have come (geometry_msgs/TransformStamped).
    """

    def __init__(self, node: Node, heard: Callable[[list[Any]], None]) -> None:
        self._node = node
        self._heard = heard
        self._buffer: Any = None
        self._errors: Any = None  # tf2_ros
        self._deaf = "TF is not listened to"  # why it is not
        self._unusable = UnusableTransforms()
        self._undo = contextlib.ExitStack()

    def configure(self, config: NodeConfig) -> None:
        """Listen if these settings need it.

        Raises:
            ValueError: without tf2_ros.
        """
        if what := needed(config):
            self._listen(import_tf2_ros(what))

    def listen(self, what: str) -> None:
        """Listen because of what has come; without tf2_ros, whoever asks is told."""
        try:
            self._listen(import_tf2_ros(what))
        except ValueError as error:
            self._deaf = str(error)

    def _listen(self, tf2_ros: Any) -> None:
        if self._buffer is not None:
            return
        buffer = tf2_ros.Buffer()
        # By its own clock tf2 would not see the time of a simulation or a recording go back.
        jumps = self._node.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
            ),
            post_callback=lambda _: buffer.clear(),
        )
        self._errors, self._buffer = tf2_ros, buffer
        listener = _listen(tf2_ros, buffer, self._node, self._hear)
        for undo in (jumps.unregister, listener.unregister):
            self._undo.callback(undo)

    def _hear(self, transforms: list[Any]) -> None:
        for item in transforms:
            self._unusable.read(item)
        self._heard(transforms)

    def close(self) -> None:
        """Stop listening; whoever asks for a transform gets none."""
        self._buffer = None
        self._undo.close()

    def lookup(self, target: str, source: str, stamp_ns: int | None) -> Transform:
        """``target_from_source`` at a time; None: the latest.

        Raises:
            NotYetError: when it is known for earlier times.
            TransformError: when it is not known otherwise.
        """
        return read_transform(self._ask(target, source, stamp_ns).transform)

    def moves(self, target: str, source: str) -> bool:
        """True if a part of the transform comes with a time.

        Raises:
            TransformError: when it is not known at all.
        """
        return self.latest(target, source)[0] != 0

    def latest(self, target: str, source: str) -> tuple[int, Transform]:
        """Stamp (ns) of the newest ``target_from_source``, and that; 0: it is static.

        Raises:
            TransformError: when it is not known at all.
        """
        found = self._ask(target, source, None)
        return stamp_of(found), read_transform(found.transform)

    def _ask(self, target: str, source: str, stamp_ns: int | None) -> Any:
        """The geometry_msgs/TransformStamped that tf2 has now."""
        buffer = self._buffer
        if buffer is None:
            raise TransformError(self._deaf)
        if stamp_ns is not None and stamp_ns <= 0:  # which would mean the latest
            raise TransformError(f"there are no transforms of the time {stamp_ns * 1e-9:.3f} s")
        try:
            return buffer.lookup_transform(target, source, Time(nanoseconds=stamp_ns or 0))
        except self._errors.ExtrapolationException as error:
            text = _text(error)
        except self._errors.TransformException as error:
            raise TransformError(self._unusable.explain(_text(error))) from error
        latest_ns = None
        with contextlib.suppress(self._errors.TransformException):
            latest_ns = stamp_of(buffer.lookup_transform(target, source, Time()))
        if stamp_ns is not None and latest_ns is not None:
            if latest_ns < stamp_ns:
                raise NotYetError(text)
            if latest_ns - stamp_ns > _MEMORY:
                # A recording that starts over: tf2 would ignore all that comes from now on.
                buffer.clear()
        raise TransformError(text)


def _listen(tf2_ros: Any, buffer: Any, node: Node, hear: Callable[[list[Any]], None]) -> Any:
    """A tf2_ros.TransformListener that tells of what has come."""

    class Listener(tf2_ros.TransformListener):  # type: ignore[misc]
        def callback(self, data: Any) -> None:
            super().callback(data)
            hear(data.transforms)

        def static_callback(self, data: Any) -> None:
            super().static_callback(data)
            hear(data.transforms)

    return Listener(buffer, node)


def _text(error: Exception) -> str:
    return " ".join(str(error).split())


# Frames that wait for odometry, which mostly comes later than they do.
_MOST_PENDING = 100
# Odometry that goes back by more (ns) has started over.
_RESTART = 500_000_000


class Broadcaster:
    """TF's side of the outputs.

    ``map_to_odom`` never stops: with each frame there is a new correction of odometry, and that is
    sent ``tf_rate`` times a second, as long as odometry comes, stamped ``transform_tolerance``
    ahead of it, so that whoever asks for a time that odometry knows has an answer.

    :meth:`publish` may be called from any thread, all else belongs to the executor's.

    Args:
        node: sends, and listens for the odometry.
        refusals: told of what was not sent, and of jumps.
    """

    def __init__(self, node: Node, refusals: Refusals) -> None:
        self.tf = Tf(node, self._hear)
        self._node = node
        self._refusals = refusals
        self._broadcaster: Any = None
        self._timer: Any = None
        self._config: NodeConfig | None = None
        self._sending = threading.Lock()  # of the next three
        # With when they are given up, time.monotonic().
        self._pending: deque[tuple[Localized, NodeConfig, float]] = deque(maxlen=_MOST_PENDING)
        self._correction, self._map_frame = MapToOdom(), ""
        self._sent_ns = 0  # the newest stamp of map -> odom
        self._holding: Holding | None = None
        self._body = ""  # frame of the body whose correction is held
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
        self._stop_timer()
        self._config = config
        if config.publish_tf == PublishTf.MAP_TO_ODOM and config.tf_rate > 0.0:
            self._timer = steady_timer(self._node, 1.0 / config.tf_rate, self._tick)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def forget(self) -> None:
        """Send nothing of the frames so far."""
        with self._sending:
            self._pending.clear()
            self._correction.forget()
            self._failed = self._holding = None

    def fault(self) -> dict[str, str]:
        """For the diagnostics: why nothing has been sent lately, if something should have been."""
        failed = self._failed
        since = time.monotonic() - WINDOW
        if failed is None or failed[0] < since or self._sent >= since:
            return {}
        return {Notice.NOT_BROADCAST: failed[1]}

    @property
    def holding(self) -> Holding | None:
        """Age and deviations of the correction of odometry; None: there has been none."""
        return self._holding

    def close(self) -> None:
        self.forget()
        self._stop_timer()
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
            self._pending.append((frame, config, deadline))
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
            for frame, config, deadline in waiting:
                try:
                    self._take(frame, config)
                except TransformError as error:
                    if isinstance(error, NotYetError) and time.monotonic() < deadline:
                        self._pending.append((frame, config, deadline))
                    else:
                        self._say(config, error)

    def _take(self, frame: Localized, config: NodeConfig) -> None:
        if config.publish_tf != PublishTf.MAP_TO_ODOM:
            if (item := broadcast(frame, config, self.tf)) is not None:
                self._send(item)
            return
        check_time(frame)
        body_in_odom = self.tf.lookup(config.odom_frame, frame.body_frame, frame.stamp_ns)
        last = self._correction.stamp_ns
        if frame.map_frame != self._map_frame or (last is not None and frame.stamp_ns < last):
            self._correction.forget()
            self._map_frame = frame.map_frame
        first = self._correction.stamp_ns is None
        if jump := self._correction.take(frame, body_in_odom, two_d=config.two_d_mode):
            self._refusals.notice(Notice.MAP_JUMPED, jump)
        if first:  # nobody shall have to wait for the time that it is stamped ahead
            self._sent_ns = 0
            self._send_correction(frame.stamp_ns, config)
        self._hold(frame.body_frame, config)

    def _tick(self) -> None:
        config = self._config
        if config is None or config.publish_tf != PublishTf.MAP_TO_ODOM:
            return
        with self._sending:
            try:
                self._hold(self._body, config)
            except TransformError as error:
                self._say(config, error)

    def _hold(self, body_frame: str, config: NodeConfig) -> None:
        """Send what is held ahead of the newest odometry, if that is new."""
        self._body = body_frame
        if self._correction.stamp_ns is None:
            return
        newest_ns, body_in_odom = self.tf.latest(config.odom_frame, body_frame)
        newest_ns = newest_ns or self._node.get_clock().now().nanoseconds
        self._holding = self._correction.holding(newest_ns, body_in_odom, config.hold)
        ahead_ns = newest_ns + round(config.transform_tolerance * 1e9)
        if ahead_ns < self._sent_ns - _RESTART:
            self._sent_ns = 0
        if ahead_ns > self._sent_ns:
            self._send_correction(ahead_ns, config, newest_ns)

    def _send_correction(self, stamp_ns: int, config: NodeConfig, now_ns: int = 0) -> None:
        held = self._correction.held(now_ns or stamp_ns, config.hold)
        if held is not None:
            self._send(Broadcast(stamp_ns, self._map_frame, config.odom_frame, held))
            self._sent_ns = stamp_ns

    def _say(self, config: NodeConfig, error: TransformError) -> None:
        text = f"publish_tf {config.publish_tf}: {error}"
        self._failed = time.monotonic(), text
        self._refusals.notice(Notice.NOT_BROADCAST, text)

    def _send(self, item: Broadcast) -> None:
        if self._broadcaster is None:
            return
        other = self._parents.get(item.child, item.parent)
        if other != item.parent:
            raise TransformError(
                f"TF frame {item.child!r} already has parent {other!r}; "
                "choose publish_tf map_to_odom, or the root of the camera's frames as base_frame"
            )
        self._own.add((item.parent, item.child))
        self._broadcaster.sendTransform(
            make_transform(
                make_message, item.stamp_ns, item.parent, item.child, item.parent_from_child
            )
        )
        self._sent = time.monotonic()
