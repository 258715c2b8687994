"""Runs the node in a process of its own."""

from __future__ import annotations

import os
import sys

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from rs_localizer.ros.errors import describe
from rs_localizer.ros.localizer_node import LocalizerNode
from rs_localizer.ros.worker import wait_for_workers
from rs_localizer.settings import NODE_NAME
from rs_localizer.stopping import StopRequest

# A waiting executor does not see signals: it looks up this often, in s.
_SIGNAL_LATENCY = 0.1
# How long the end waits for the frame that is worked on, in s.
_LAST_FRAME_TIMEOUT = 0.5


def run(stop: StopRequest, args: list[str] | None = None) -> int:
    """Run the node until ``stop`` is requested; the exit code."""
    try:
        # rclpy's own handlers end the context from a thread while the node still uses it.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = LocalizerNode(compiling=stop.at_once)
    except (ValueError, RuntimeError) as error:
        rclpy.logging.get_logger(NODE_NAME).fatal(" ".join(str(error).split()))
        rclpy.try_shutdown()
        return 1
    try:
        code = _run(node, stop)
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


def _run(node: LocalizerNode, stop: StopRequest) -> int:
    if node.autostart:
        for transition in (node.trigger_configure, node.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stop.requested:
        try:
            executor.spin_once(timeout_sec=_SIGNAL_LATENCY)
        except ExternalShutdownException:
            raise
        except Exception as error:  # one callback's: the others go on
            node.refusals.add("internal_error", describe(error))
    executor.remove_node(node)
    return 0
