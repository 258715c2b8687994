# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TF's side of the outputs: sends transforms, and hears who else does."""

import functools
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.core.reasons import Notice
from rs_localizer.io.atomic_files import OutputError
from rs_localizer.io.messages import make_header, make_quaternion, make_vector
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import LIVE, MAP_TO_ODOM
from rs_localizer.io.transforms import NotYetError, TransformError, make_transform
from rs_localizer.pipeline.carried_pose import Click, FoundPose, Odometry
from rs_localizer.pipeline.given_pose import PERIOD, GivenPose, load_pose, save_pose
from rs_localizer.pipeline.map_to_odom import CorrectionState, Decision, Settings, Standing, decide
from rs_localizer.pipeline.published import Broadcast, broadcast, pose_in_odometry
from rs_localizer.ros.localizer.rivals import Rivals
from rs_localizer.ros.localizer.tf import Tf, import_tf2_ros, needed
from rs_localizer.ros.node.conversion import make_message, message_class, steady_timer
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import WINDOW

# Frames that wait for odometry, which mostly comes later than they do.
_MOST_PENDING = 100
# Odometry that goes back by more (ns) has started over.
_RESTART = 500_000_000


class Broadcaster:
    """Sends the transform that ``publish_tf`` asks for.

    ``map_to_odom`` never stops. As long as odometry comes, the transform that :func:`.decide` holds
    is sent ``tf_rate`` times a second. It is stamped ``transform_tolerance`` ahead of the odometry,
    so that every lookup at a time that odometry knows succeeds. Its covariance goes to
    ``~/map_to_odom``.

    :meth:`publish` and :meth:`give` may be called from any thread, all other methods only from the
    thread of the executor.

    Args:
        node: sends, and listens for the odometry.
        refusals: logs what was not sent, and contradictions.
    """

    def __init__(self, node: Node, refusals: Refusals) -> None:
        self.tf = Tf(node, self._hear)
        self._node = node
        self._refusals = refusals
        self._broadcaster: Any = None
        self._publisher: Any = None  # of ~/map_to_odom
        self._timer: Any = None
        self._config: NodeConfig | None = None
        self._rivals = Rivals()
        self._sending = threading.Lock()  # of the next ones
        # Calls that wait for odometry, and the time.monotonic() at which each is given up.
        self._pending: deque[tuple[Callable[[bool], None], float]] = deque(maxlen=_MOST_PENDING)
        self._state, self._map_frame = CorrectionState(), ""
        self._decision: Decision | None = None
        self._sent_ns = 0  # the newest stamp of map -> odom
        self._body = ""  # frame of the body whose correction is held
        self._answer = ""  # to the last given pose
        self._saved: GivenPose | None = None  # of a file; taken when odometry has come
        self._save_at = 0.0  # time.monotonic()
        self._sent = 0.0  # when, likewise
        self._failed: tuple[float, str] | None = None

    def configure(self, config: NodeConfig) -> None:
        """Create what these settings need.

        Raises:
            ValueError: without tf2_ros; for a file that holds no pose.
        """
        self.tf.configure(config)
        if config.publish_tf != PublishTf.NONE and self._broadcaster is None:
            self._broadcaster = import_tf2_ros(needed(config)).TransformBroadcaster(self._node)
        self._stop_timer()
        corrects = config.publish_tf == PublishTf.MAP_TO_ODOM
        if corrects and self._publisher is None:
            kind = message_class(LIVE[MAP_TO_ODOM])
            self._publisher = self._node.create_publisher(kind, f"~/{MAP_TO_ODOM}", 10)
            if config.saved_pose_file:
                self._saved = load_pose(Path(config.saved_pose_file))
        self._config, self._body = config, self._body or config.base_frame
        if corrects and config.tf_rate > 0.0:
            self._timer = steady_timer(self._node, 1.0 / config.tf_rate, self._tick)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def forget(self) -> None:
        """Send nothing of the frames so far."""
        with self._sending:
            self._save()
            self._pending.clear()
            self._forget_pose()
            self._failed, self._answer = None, ""

    def jumped(self, seconds: float) -> None:
        """Forget odometry after a jump of time: it was of another drive."""
        self.tf.clear()
        self.forget()
        self._refusals.notice(
            Notice.TIME_JUMPED, f"the clock jumped by {seconds:.1f} s: transforms are forgotten"
        )

    def _forget_pose(self) -> None:
        """Forget the held pose; the drift stays, as odometry is the same."""
        self._state, self._decision = CorrectionState(drift=self._state.drift), None

    def fault(self) -> dict[str, str]:
        """Say for the diagnostics why nothing has been sent lately that should have been."""
        failed, since = self._failed, time.monotonic() - WINDOW
        missing = failed is not None and failed[0] >= since and self._sent < since
        found = {Notice.NOT_BROADCAST: failed[1]} if failed and missing else {}
        return found | self._rivals.static

    @property
    def decision(self) -> Decision | None:
        """The last one on ``map -> odom``; None: there has been none."""
        return self._decision

    @property
    def values(self) -> dict[str, str]:
        """For the diagnostics, by readable names."""
        decision = self._decision
        values = {"Last given pose": self._answer} if self._answer else {}
        if decision is None:
            return values
        values |= {"map -> odom": str(decision.standing), "Correction of odometry": str(decision)}
        if decision.smallest is not None:
            metres, radians = decision.smallest
            text = f"{100.0 * metres:.2g} cm, {np.degrees(radians):.2g} deg"
            values["Smallest jump that is refused"] = text
        return values

    def close(self) -> None:
        self.forget()
        self._stop_timer()
        self.tf.close()
        if self._broadcaster is not None:
            self._node.destroy_publisher(self._broadcaster.pub_tf)
            self._broadcaster = None
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None

    def publish(self, frame: Localized, config: NodeConfig) -> None:
        """Send the frame's transform: now, or when odometry has come so far.

        After ``transform_tolerance`` it is given up.
        """
        if config.publish_tf != PublishTf.NONE:
            self._await(functools.partial(self._take, frame, config), config)

    def give(self, given: GivenPose) -> None:
        """Take a pose that a user gives, for ``map_to_odom``."""
        config = self._config
        if config is not None and config.publish_tf == PublishTf.MAP_TO_ODOM:
            self._await(functools.partial(self._click, given, config), config)

    def _await(self, take: Callable[[bool], None], config: NodeConfig) -> None:
        with self._sending:
            self._pending.append((take, time.monotonic() + config.transform_tolerance))
        self._flush()

    def _hear(self, transforms: list[Any], static: bool) -> None:
        for item in transforms:
            for notice, text in self._rivals.hear(item, self._decision, static=static).items():
                self._refusals.notice(notice, text)
        self._flush()

    def _flush(self) -> None:
        with self._sending:
            waiting = list(self._pending)
            self._pending.clear()
            for take, deadline in waiting:
                last = time.monotonic() >= deadline
                try:
                    take(last)
                except TransformError as error:
                    if isinstance(error, NotYetError) and not last:
                        self._pending.append((take, deadline))
                    else:
                        self._say(error)

    def _take(self, frame: Localized, config: NodeConfig, last: bool) -> None:
        """Send the transform that follows from a frame."""
        if config.publish_tf != PublishTf.MAP_TO_ODOM:
            item, _ = broadcast(frame, config, self.tf, self._state)
            if item is not None:
                self._send(item)
            return
        pose = pose_in_odometry(frame, config, self.tf)
        if frame.map_frame != self._map_frame:
            self._forget_pose()
            self._map_frame = frame.map_frame
        decision = self._begin(pose, config)
        if decision.said:
            self._refusals.notice(Notice.MAP_JUMPED, decision.said)
        if decision.standing is Standing.CONTRADICTED:
            self._refusals.notice(Notice.CONTRADICTED, str(decision))
        self._body = frame.body_frame
        self._hold(config)

    def _click(self, given: GivenPose, config: NodeConfig, last: bool) -> None:
        """Take a given pose, and answer."""
        body, frame = given.body or self._body, given.frame
        if not body:
            text = "refused: set base_frame, of which it is the pose"
        elif frame in (config.odom_frame, body) or self._map_frame not in ("", frame):
            text = (
                f"refused: it is in {frame!r}, the map is {self._map_frame or config.map_frame!r}"
            )
        else:
            text = self._clicked(given, body, config, last)
        self._answer = f"{text} ({time.strftime('%H:%M:%S')})"
        self._refusals.notice(Notice.POSE_GIVEN, text)

    def _clicked(self, given: GivenPose, body: str, config: NodeConfig, last: bool) -> str:
        late = ""
        try:
            stamp = given.stamp_ns or None
            odom = self.tf.lookup(config.odom_frame, body, stamp)
        except TransformError as error:
            if isinstance(error, NotYetError) and not last:
                raise
            late = f"; odometry does not know its time: {error}"
            stamp = None
        newest_ns, newest = self.tf.latest(config.odom_frame, body)
        if stamp is None:
            odom, stamp = newest, newest_ns or self._now_ns
        self._body, self._map_frame = body, given.frame
        at = Odometry(stamp, odom)
        text = self._begin(Click(at, given.pose, given.allowed), config).said
        self._hold(config)
        return text + late

    def _begin(self, seen: FoundPose, config: NodeConfig) -> Decision:
        """Decide, and send the first transform at once."""
        first = self._state.held is None
        decision = self._decide(seen, config)
        if first:  # nobody shall have to wait for the time that it is stamped ahead
            self._sent_ns = 0
            self._send_correction(seen.at.stamp_ns, config)
        return decision

    @property
    def _now_ns(self) -> int:
        now_ns: int = self._node.get_clock().now().nanoseconds
        return now_ns

    def _decide(self, seen: Odometry | FoundPose, config: NodeConfig) -> Decision:
        decision = decide(Settings(config.two_d_mode, config.hold), self._state, seen)
        self._state, self._decision = decision.state, decision
        return decision

    def _tick(self) -> None:
        config = self._config
        if config is None or config.publish_tf != PublishTf.MAP_TO_ODOM:
            return
        with self._sending:
            try:
                if self._saved is not None and self._state.held is None and self._body:
                    saved, self._saved = self._saved, None
                    self._await_saved(saved, config)
                self._hold(config)
            except TransformError as error:
                self._say(error)
            if time.monotonic() >= self._save_at:
                self._save()

    def _await_saved(self, saved: GivenPose, config: NodeConfig) -> None:
        try:
            self.tf.latest(config.odom_frame, self._body)
        except TransformError:  # odometry has not come yet
            self._saved = saved
        else:
            self._click(saved, config, True)

    def _save(self) -> None:
        """Keep the pose in the file that the settings name."""
        self._save_at = time.monotonic() + PERIOD
        file = "" if self._config is None else self._config.saved_pose_file
        decision, newest = self._decision, self._state.newest
        if not file or decision is None or newest is None or decision.map_from_odom is None:
            return
        if decision.standing is Standing.CONTRADICTED or decision.covariance is None:
            return
        where = decision.map_from_odom @ newest.odom_from_body
        try:
            save_pose(Path(file), self._map_frame, where, decision.covariance)
        except OutputError as error:
            self._refusals.notice(Notice.NOT_BROADCAST, f"saved_pose_file: {error}")

    def _hold(self, config: NodeConfig) -> None:
        """Send the held transform, stamped ahead of the newest odometry, if that is new."""
        if self._state.held is None:
            return
        newest_ns, odom = self.tf.latest(config.odom_frame, self._body)
        newest_ns = newest_ns or self._now_ns
        self._decide(Odometry(newest_ns, odom), config)
        ahead_ns = newest_ns + round(config.transform_tolerance * 1e9)
        if ahead_ns < self._sent_ns - _RESTART:
            self._sent_ns = 0
        if ahead_ns > self._sent_ns:
            self._send_correction(ahead_ns, config)

    def _send_correction(self, stamp_ns: int, config: NodeConfig) -> None:
        decision = self._decision
        if decision is None or (correction := decision.map_from_odom) is None:
            return
        self._send(Broadcast(stamp_ns, self._map_frame, config.odom_frame, correction))
        self._sent_ns = stamp_ns
        if self._publisher is not None and self._publisher.get_subscription_count():
            assert decision.of_transform is not None
            pose = make_message(
                "geometry_msgs/msg/Pose",
                position=make_vector(make_message, correction.translation, "Point"),
                orientation=make_quaternion(make_message, correction.rotation),
            )
            spread = {"pose": pose, "covariance": decision.of_transform.ravel()}
            self._publisher.publish(
                make_message(
                    LIVE[MAP_TO_ODOM],
                    header=make_header(make_message, stamp_ns, self._map_frame),
                    pose=make_message("geometry_msgs/msg/PoseWithCovariance", **spread),
                )
            )

    def _say(self, error: TransformError) -> None:
        text = f"publish_tf {'' if self._config is None else self._config.publish_tf}: {error}"
        self._failed = time.monotonic(), text
        self._refusals.notice(Notice.NOT_BROADCAST, text)

    def _send(self, item: Broadcast) -> None:
        if self._broadcaster is None:
            return
        other = self._rivals.parent(item)
        if other != item.parent:
            raise TransformError(
                f"TF frame {item.child!r} already has parent {other!r}; "
                "choose publish_tf map_to_odom, or the root of the camera's frames as base_frame"
            )
        message = make_transform(
            make_message, item.stamp_ns, item.parent, item.child, item.parent_from_child
        )
        self._rivals.send(message)
        self._broadcaster.sendTransform(message)
        self._sent = time.monotonic()
