# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TF's side of the outputs: sends transforms, and hears who else does."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.core.reasons import Notice
from rs_localizer.io.messages import make_header
from rs_localizer.io.outputs import BodyPose, Localized, make_pose_with_covariance
from rs_localizer.io.topics import LIVE, MAP_TO_ODOM
from rs_localizer.io.transforms import NotYetError, Transform, TransformError, make_transform
from rs_localizer.pipeline.carried_pose import Click, FoundPose, Odometry
from rs_localizer.pipeline.given_pose import GivenPose
from rs_localizer.pipeline.map_to_odom import CorrectionState, Decision, Standing, decide
from rs_localizer.pipeline.published import Broadcast, pose_in_odometry, pose_transform
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
        self._node, self._refusals, self._config = node, refusals, NodeConfig()
        self._broadcaster: Any = None
        self._publisher: Any = None  # of ~/map_to_odom
        self._timer: Any = None
        self._rivals = Rivals()
        self._sending = threading.Lock()  # of the next ones
        # Calls that wait for odometry, and the time.monotonic() at which each is given up.
        self._pending: deque[tuple[Callable[[bool], None], float]] = deque(maxlen=_MOST_PENDING)
        self._state, self._map_frame = CorrectionState(), ""
        self.decision: Decision | None = None
        """The last one on ``map -> odom``; None: there has been none."""
        self._sent_ns = 0  # the newest stamp of map -> odom
        self._body = ""  # frame of the body whose correction is held
        self._answer = ""  # to the last given pose
        self._sent = 0.0  # time.monotonic()
        self._failed = -math.inf, ""  # when, likewise, and why

    def configure(self, config: NodeConfig) -> None:
        """Create what these settings need.

        Raises:
            ValueError: without tf2_ros.
        """
        if what := needed(config):
            self.tf.listen(what)
        if config.publish_tf != PublishTf.NONE and self._broadcaster is None:
            self._broadcaster = import_tf2_ros(what).TransformBroadcaster(self._node)
        self._stop_timer()
        self._config, self._body = config, self._body or config.base_frame
        if not self._corrects:
            return
        if self._publisher is None:
            kind = message_class(LIVE[MAP_TO_ODOM])
            self._publisher = self._node.create_publisher(kind, f"~/{MAP_TO_ODOM}", 10)
        if config.tf_rate > 0.0:
            self._timer = steady_timer(self._node, 1.0 / config.tf_rate, self._tick)

    @property
    def _corrects(self) -> bool:
        return self._config.publish_tf == PublishTf.MAP_TO_ODOM

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def forget(self) -> None:
        """Send nothing of the frames so far."""
        with self._sending:
            self._pending.clear()
            self._forget_pose()
            self._failed, self._answer = (-math.inf, ""), ""

    def jumped(self, seconds: float) -> None:
        """Forget odometry after a jump of time: it was of another drive."""
        self.tf.clear()
        self.forget()
        self._refusals.notice(
            Notice.TIME_JUMPED, f"the clock jumped by {seconds:.1f} s: transforms are forgotten"
        )

    def _forget_pose(self) -> None:
        """Forget the held pose; the drift stays, as odometry is the same."""
        self._state, self.decision = CorrectionState(drift=self._state.drift), None

    def fault(self) -> dict[str, str]:
        """Say for the diagnostics why nothing has been sent lately that should have been."""
        (when, text), since = self._failed, time.monotonic() - WINDOW
        missing, static = when >= since > self._sent, self._rivals.static
        faults: dict[str, str] = {Notice.NOT_BROADCAST: text} if missing else {}
        return faults | ({Notice.SECOND_BROADCASTER: static} if static else {})

    @property
    def values(self) -> dict[str, str]:
        """For the diagnostics, by readable names."""
        values = {"Last given pose": self._answer} if self._answer else {}
        if (decision := self.decision) is None:
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
        for publisher in (self._broadcaster and self._broadcaster.pub_tf, self._publisher):
            if publisher is not None:
                self._node.destroy_publisher(publisher)
        self._broadcaster = self._publisher = None

    def publish(self, frame: Localized) -> None:
        """Send the frame's transform: now, or when odometry has come so far.

        After ``transform_tolerance`` it is given up.
        """
        if self._corrects:
            self._await(lambda last: self._take(frame))
        elif self._config.publish_tf != PublishTf.NONE:
            self._await(lambda last: self._send(pose_transform(frame)))

    def give(self, given: GivenPose) -> None:
        """Take a pose that a user gives, for ``map_to_odom``."""
        if self._corrects:
            self._await(lambda last: self._click(given, last))

    def _await(self, take: Callable[[bool], None]) -> None:
        with self._sending:
            self._pending.append((take, time.monotonic() + self._config.transform_tolerance))
        self._flush()

    def _hear(self, transforms: list[Any], static: bool) -> None:
        for item in transforms:
            self._tell_rival(item, static)
        self._flush()

    def _tell_rival(self, item: Any, static: bool) -> None:
        if text := self._rivals.hear(item, static=static):
            self._refusals.notice(Notice.SECOND_BROADCASTER, text)

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

    def _take(self, frame: Localized) -> None:
        """Correct odometry by a frame's pose."""
        pose = pose_in_odometry(frame, self._config, self.tf)
        if frame.map_frame != self._map_frame:
            self._forget_pose()
            self._map_frame = frame.map_frame
        decision = self._begin(pose)
        if decision.said:
            self._refusals.notice(Notice.MAP_JUMPED, decision.said)
        if decision.standing is Standing.CONTRADICTED:
            self._refusals.notice(Notice.CONTRADICTED, str(decision))
        self._body = frame.body_frame
        self._hold()

    def _click(self, given: GivenPose, last: bool) -> None:
        """Take a given pose, and answer."""
        try:
            text = self._clicked(given, last)
        except NotYetError:
            raise
        except TransformError as error:
            text = f"refused: {error}"
        self._answer = f"{text} ({time.strftime('%H:%M:%S')})"
        self._refusals.notice(Notice.POSE_GIVEN, text)

    def _clicked(self, given: GivenPose, last: bool) -> str:
        """Take a given pose, if possible; return the answer."""
        odom_frame, body, frame = self._config.odom_frame, self._body, given.frame
        if not body:
            return "refused: set base_frame, of which it is the pose"
        if frame in (odom_frame, body) or self._map_frame not in ("", frame):
            known = self._map_frame or self._config.map_frame
            return f"refused: it is in {frame!r}, the map is {known!r}"
        late, stamp = "", given.stamp_ns or None
        try:
            odom = self.tf.lookup(odom_frame, body, stamp)
        except TransformError as error:
            if isinstance(error, NotYetError) and not last:
                raise
            late, stamp = f"; odometry does not know its time: {error}", None
        if stamp is None:
            stamp, odom = self._newest(body)
        self._map_frame = frame
        said = self._begin(Click(Odometry(stamp, odom), given.pose, given.allowed)).said
        self._hold()
        return said + late

    def _newest(self, body: str) -> tuple[int, Transform]:
        """Return the stamp of the newest odometry, and it; of now if it is static."""
        stamp_ns, odom = self.tf.latest(self._config.odom_frame, body)
        return stamp_ns or self._node.get_clock().now().nanoseconds, odom

    def _begin(self, seen: FoundPose) -> Decision:
        """Decide, and send the first transform at once."""
        first = self._state.held is None
        decision = self._decide(seen)
        if first:  # nobody shall have to wait for the time that it is stamped ahead
            self._sent_ns = 0
            self._send_correction(seen.at.stamp_ns)
        return decision

    def _decide(self, seen: Odometry | FoundPose) -> Decision:
        self.decision = decide(self._config, self._state, seen)
        self._state = self.decision.state
        return self.decision

    def _tick(self) -> None:
        with self._sending:
            try:
                self._hold()
            except TransformError as error:
                self._say(error)

    def _hold(self) -> None:
        """Send the held transform, stamped ahead of the newest odometry, if that is new."""
        if self._state.held is None:
            return
        odometry = Odometry(*self._newest(self._body))
        self._decide(odometry)
        ahead_ns = odometry.stamp_ns + round(self._config.transform_tolerance * 1e9)
        if ahead_ns < self._sent_ns - _RESTART:
            self._sent_ns = 0
        if ahead_ns > self._sent_ns:
            self._send_correction(ahead_ns)

    def _send_correction(self, stamp_ns: int) -> None:
        decision = self.decision
        if decision is None or (correction := decision.map_from_odom) is None:
            return
        self._send(Broadcast(stamp_ns, self._map_frame, self._config.odom_frame, correction))
        self._sent_ns = stamp_ns
        if self._publisher is not None and self._publisher.get_subscription_count():
            assert decision.of_transform is not None
            pose = BodyPose(correction.translation, correction.rotation, decision.of_transform)
            made = make_pose_with_covariance(pose, make_message)
            header = make_header(make_message, stamp_ns, self._map_frame)
            self._publisher.publish(make_message(LIVE[MAP_TO_ODOM], header=header, pose=made))

    def _say(self, error: TransformError) -> None:
        text = f"publish_tf {self._config.publish_tf}: {error}"
        self._failed = time.monotonic(), text
        self._refusals.notice(Notice.NOT_BROADCAST, text)

    def _send(self, item: Broadcast) -> None:
        if self._broadcaster is None:
            return
        other = self._rivals.parent(item)
        if other != item.parent:
            advice = (
                "choose publish_tf map_to_odom, or the root of the camera's frames as base_frame"
            )
            if self._corrects:
                advice = "end the node that sends that"
            raise TransformError(f"TF frame {item.child!r} already has parent {other!r}; {advice}")
        message = make_transform(
            make_message, item.stamp_ns, item.parent, item.child, item.parent_from_child
        )
        early = self._rivals.send(message)
        self._broadcaster.sendTransform(message)
        if early is not None:
            self._tell_rival(early, True)
        self._sent = time.monotonic()
