"""Runs a node in a process of its own."""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from rs_localizer.process.stopping import StopRequest
from rs_localizer.ros.node.managed import ManagedNode
from rs_localizer.ros.node.refusals import describe
from rs_localizer.ros.node.worker import wait_for_workers

# A waiting executor does not see signals: it looks up this often, in s.
_SIGNAL_LATENCY = 0.1
# How long the end waits for the frame that is worked on, in s.
_LAST_FRAME_TIMEOUT = 0.5
# How long a thread waits for the GIL before it asks for it, in s.
_SWITCH_INTERVAL = 0.001


def run(
    make: Callable[[], ManagedNode[Any, Any, Any, Any]],
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
    try:
        code = _start(node, stop) or spin(node, lambda: stop.requested)
    except ExternalShutdownException:
        code = 0
    finally:
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
        prepared = node.prepare()
        spin(node, lambda: stop.requested or prepared.done())
        if stop.requested:
            return 0
        if not node.configure(prepared.result()):
            return 1
    # What has been compiled stays; to look through it for garbage takes some tenths of a second,
    # and must not come between frames.
    gc.collect()
    gc.freeze()
    waits = node.autostart and node.state == "inactive"  # a client may have been faster
    if waits and node.trigger_activate() != TransitionCallbackReturn.SUCCESS:
        return 1
    # Other threads than the worker have little to do and give the GIL back soon.
    sys.setswitchinterval(_SWITCH_INTERVAL)
    return 0


def spin(node: Any, stopped: Callable[[], bool]) -> int:
    """Run the callbacks of the node's executor, which no error of theirs ends; the exit code."""
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while not stopped():
        try:
            executor.spin_once(timeout_sec=_SIGNAL_LATENCY)
        except ExternalShutdownException:
            raise
        except Exception as error:  # one callback's: the others go on
            node.refusals.add("internal_error", describe(error))
    executor.remove_node(node)
    return 0
