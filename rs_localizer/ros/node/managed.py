# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A managed node with a worker, the base of all nodes of this package.

Two threads: the executor's takes messages, answers services, changes parameters and the life cycle,
and publishes diagnostics; the worker's does the work and publishes its results.
"""

import contextlib
import functools
import gc
import os
import sys
import traceback
import uuid
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, TypeVar

import rclpy
from lifecycle_msgs.srv import ChangeState
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from rs_localizer.process.stopping import StopRequest, ends_within
from rs_localizer.ros.node.conversion import message_class, steady_timer
from rs_localizer.ros.node.diagnostics import Diagnostics, Health
from rs_localizer.ros.node.parameters import SettingsNode
from rs_localizer.ros.node.refusals import Refusals, describe
from rs_localizer.ros.node.statistics import Statistics, Told
from rs_localizer.ros.node.subscriptions import Inputs, Silence, Topic
from rs_localizer.ros.node.worker import Work, Worker, wait_for_workers
from rs_localizer.settings import Config

_BOND_TYPE, _BOND_TOPIC = "bond/msg/Status", "bond"
# Period and timeout (s) of nav2's own servers.
_BEAT, _BEAT_TIMEOUT = 0.1, 4.0
# Queue depth of bondcpp's publishers.
_BEAT_DEPTH = 5

Result = TypeVar("Result")


class Bond:
    """The heartbeat by which nav2's lifecycle manager sees that an active node lives.

    The manager expects a status with the node's name on ``bond``, at least once in its
    ``bond_timeout`` (4 s), and otherwise stops the robot. The messages come from the package
    ``bond``, which comes with nav2 and is not on PyPI. It beats while somebody listens, until it is
    closed.

    Args:
        node: the one that is watched.

    Raises:
        ImportError: without the package ``bond``.
    """

    def __init__(self, node: Node) -> None:
        self._status = message_class(_BOND_TYPE)
        self._node = node
        self._instance = str(uuid.uuid4())
        self._publisher = node.create_publisher(self._status, _BOND_TOPIC, _BEAT_DEPTH)
        self._timer = steady_timer(node, _BEAT, self._beat)

    def _beat(self, *, active: bool = True) -> None:
        if not (self._node.context.ok() and self._publisher.get_subscription_count()):
            return
        status = self._status(
            id=self._node.get_name(),
            instance_id=self._instance,
            active=active,
            heartbeat_timeout=_BEAT_TIMEOUT,
            heartbeat_period=_BEAT,
        )
        status.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(status)

    def close(self) -> None:
        """End it as one who leaves: the manager need not wait for the timeout."""
        self._beat(active=False)
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)


class ManagedNode(SettingsNode[Config], Generic[Config, Result]):
    """Only while active it takes and publishes messages.

    A node defines its work by overriding :meth:`check`, :meth:`open`, :meth:`begin`,
    :meth:`change` and :meth:`examine`.

    Args:
        options: of rclpy's node.
    """

    node_name: ClassVar[str]
    kind: ClassVar[Any]  # class of its settings
    tell: "ClassVar[staticmethod[[Any], tuple[int, Told]]]"  # a string: Python cannot subscript it
    """Returns the stamp (ns) and the statistics of a result."""
    task: ClassVar[str]  # in the name of the diagnosis
    lack: ClassVar[str]  # the notice of what it waits for

    def __init__(self, **options: Any) -> None:
        self.worker: Worker[Result] | None = None  # from configuring to cleaning up
        self._inputs: Inputs | None = None
        self.opened = contextlib.ExitStack()
        """The stack of calls that undo ``configure``; ``cleanup`` closes it."""
        self.active = contextlib.ExitStack()
        """The stack of calls that undo ``activate``; ``deactivate`` closes it."""
        super().__init__(self.node_name, self.kind, **options)
        self.autostart: bool = self.config.autostart
        self.refusals = Refusals(self.warn)
        self.statistics: Statistics[Result] = Statistics(
            self.refusals, self.tell, lambda: int(self.get_clock().now().nanoseconds)
        )
        self._diagnostics = Diagnostics(
            self, self.examine, self.refusals.notice, self.task, self.lack
        )
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = functools.partial(self._change_state, service.callback)

    # -- what a node does --------------------------------------------------------------------

    def open(self, config: Config) -> None:
        """Make what lives as long as :attr:`opened`, the worker by :meth:`employ`.

        Raises:
            ValueError: when it cannot be configured so, saying why.
        """
        raise NotImplementedError

    def begin(self, config: Config) -> None:
        """Listen and say so: the node is active."""
        raise NotImplementedError

    def examine(self) -> tuple[Health, str]:
        """Return the health of the node, and the frame of its camera (or empty)."""
        raise NotImplementedError

    # -- what it has for that ----------------------------------------------------------------

    @property
    def silence(self) -> dict[str, Silence]:
        """Silences of the topics that are listened to, by name."""
        return {} if self._inputs is None else self._inputs.silence()

    def employ(
        self,
        work: Work[Result],
        publish: Callable[[Result], None],
        patience: Callable[[Any], float] = lambda _: 0.0,
    ) -> Worker[Result]:
        """Start the worker; from now on only the worker uses what it works with."""
        failed = functools.partial(self.refusals.add, "internal_error")
        self.worker = Worker(work, publish, self.statistics, failed, patience)
        return self.worker

    def listen(self, topics: Mapping[str, Topic]) -> list[str]:
        """Listen to these topics instead of those so far; their full names."""
        if self._inputs is not None:
            self._inputs.close()
        self._inputs = Inputs(self, topics, self.refusals) if topics else None
        return [] if self._inputs is None else self._inputs.topics

    # -- life cycle --------------------------------------------------------------------------

    def _change_state(self, change: Callable[..., Any], request: Any, response: Any) -> Any:
        """Answer a request for a transition that the present state does not have, too.

        rclpy of Jazzy lets the error out of its callback: the client waits for ever and the
        executor stops (ros2/rclpy#1209; from Kilted on nothing comes here).
        """
        try:
            return change(request, response)
        except RuntimeError:  # RCLError; what callbacks raise does not come here
            wanted = request.transition.label or request.transition.id
            self.warn(f"transition {wanted} is refused: the node is {self.state}")
            response.success = False
            return response

    def _arrived(self, state: str, result: TransitionCallbackReturn) -> TransitionCallbackReturn:
        """Return the result of a transition to a state, which the node takes if it succeeds."""
        if result == TransitionCallbackReturn.SUCCESS:
            self.state = state
        return result

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self.open(self.config)
        except Exception as error:  # rclpy would hide it
            why = f" {error}" if isinstance(error, ValueError) else f"\n{traceback.format_exc()}"
            self.get_logger().error(f"not configured:{why}")
            self._close()
            return TransitionCallbackReturn.FAILURE
        return self._arrived("inactive", super().on_configure(state))

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # Publishers must be active before a message can come: inactive ones drop what they are
        # given.
        result = super().on_activate(state)
        try:
            self.begin(self.config)
            self._bind()
        except Exception as error:  # rclpy would hide it; QoS overrides that make no QoS
            self.get_logger().error(f"not activated: {describe(error)}")
            self._end()
            super().on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        return self._arrived("active", result)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._end()
        return self._arrived("inactive", super().on_deactivate(state))

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return self._arrived("unconfigured", super().on_cleanup(state))

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return self._arrived("finalized", super().on_shutdown(state))

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return self._arrived("unconfigured", super().on_error(state))

    def destroy_node(self) -> None:
        self._close()
        super().destroy_node()

    def _bind(self) -> None:
        """Tell nav2's lifecycle manager that the node lives, where its messages are installed."""
        try:
            self.active.callback(Bond(self).close)
        except (ImportError, AttributeError):  # not there, or another package of this name
            self.get_logger().info(
                "nav2's lifecycle manager gets no heartbeat, and needs bond_timeout 0.0: the "
                "package bond is not installed",
                once=True,
            )

    def _end(self) -> None:
        self.listen({})
        if self.worker is not None:
            self.worker.pause()
        self.active.close()

    def _close(self) -> None:
        self._end()
        if self.worker is not None:
            self.worker.close()
            self.worker = None
        self.opened.close()


# A waiting executor does not see signals: it looks up this often, in s.
_SIGNAL_LATENCY = 0.1
# Longest wait (s) at the end for the frame in progress.
_LAST_FRAME_TIMEOUT = 0.5
# Longest end (s) in all: a launch file sends SIGTERM 5 s after SIGINT, then SIGKILL.
_LONGEST_END = 4.0
# Time (s) after which a thread asks for the GIL.
_SWITCH_INTERVAL = 0.001


def run(
    make: Callable[[], ManagedNode[Any, Any]],
    name: str,
    stop: StopRequest,
    args: list[str] | None = None,
) -> int:
    """Run a node until ``stop`` is requested; the exit code.

    Args:
        make: the node's class.
        name: of the node.
        stop: asks for the end.
        args: of the command line.
    """
    try:
        # rclpy's own handlers end the context from a thread while the node still uses it.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = make()
    except (ValueError, RuntimeError) as error:
        rclpy.logging.get_logger(name).fatal(" ".join(str(error).split()))
        rclpy.try_shutdown()
        return 1
    log = node.get_logger()
    warnings.showwarning = lambda message, *_: log.warning(" ".join(str(message).split()))
    code = 1
    try:
        code = _start(node, stop) or spin(node, lambda: stop.requested)
    finally:
        with ends_within(_LONGEST_END, code):
            node.destroy_node()
            rclpy.try_shutdown()
    if not wait_for_workers(_LAST_FRAME_TIMEOUT):
        # The interpreter's own end would stop a thread inside compiled code, which may crash.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def _start(node: Any, stop: StopRequest) -> int:
    """Configure and activate the node if it is to do so itself; the exit code if that failed."""
    if stop.requested:
        return 0
    if node.autostart:
        if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
            return 1
        if stop.requested:
            return 0
    # Imported objects stay. Searching them for garbage takes some tenths of a second and must not
    # happen between frames.
    gc.collect()
    gc.freeze()
    if node.autostart and node.trigger_activate() != TransitionCallbackReturn.SUCCESS:
        return 1
    # Other threads than the worker have little to do and give the GIL back soon.
    sys.setswitchinterval(_SWITCH_INTERVAL)
    return 0


def executor_of(context: Context) -> Executor:
    """Return an executor at a third of the cost per message, if rclpy has it (from 7.1.4)."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def spin(node: Any, stopped: Callable[[], bool]) -> int:
    """Run the node's callbacks, errors of which end nothing, until it is to stop; the exit code."""
    executor = executor_of(node.context)
    executor.add_node(node)
    while node.context.ok() and not stopped():
        try:
            executor.spin_once(timeout_sec=_SIGNAL_LATENCY)
        except ExternalShutdownException:
            break
        except Exception as error:  # one callback's: the others go on
            node.refusals.add("internal_error", describe(error))
    executor.remove_node(node)
    return 0
