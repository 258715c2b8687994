"""Takes messages in a thread that does nothing else.

The executor of rclpy looks at every timer, service and event of its node for each message that
comes. This costs more than to take the message, and holds the GIL, which the worker needs.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription

from rs_localizer.ros.node.refusals import describe

# A context that is shut down by others wakes nobody: it is looked at this often, in ns.
_CONTEXT_PERIOD = 200_000_000


class NotByExecutor(CallbackGroup):
    """Subscriptions whose messages an :class:`Intake` takes."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class Intake:
    """Calls the callbacks of subscriptions, in their order when several have messages.

    Args:
        context: that of their node.
        subscriptions: in a callback group :class:`NotByExecutor`.
        failed: told in one sentence of errors in callbacks; the thread goes on.
    """

    def __init__(
        self,
        context: Context,
        subscriptions: Sequence[Subscription],
        failed: Callable[[str], None],
    ) -> None:
        self._context = context
        self._subscriptions = subscriptions
        self._failed = failed
        self._closed = False
        handle = context.handle
        assert handle is not None  # the context of a node has been initialized
        with handle:
            # Ready-made waiting as in rclpy.wait_for_message: the public ways need an executor.
            self._wake = rclpy_implementation.GuardCondition(handle)
            self._waiting = rclpy_implementation.WaitSet(len(subscriptions), 1, 0, 0, 0, 0, handle)
        self._thread = threading.Thread(target=self._run, name="rs_localizer intake", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread after the callback that it is in; no other comes any more."""
        self._closed = True
        self._wake.trigger_guard_condition()
        self._thread.join()

    def _run(self) -> None:
        while not self._closed and self._context.ok():
            try:
                ready = self._ready()
            except Exception as error:  # without messages for once: the thread goes on
                if not self._closed and self._context.ok():
                    self._failed(describe(error))
                    time.sleep(1e-9 * _CONTEXT_PERIOD)
                continue
            for subscription in ready:
                try:
                    # Also what cannot be deserialized raises.
                    taken = subscription.handle.take_message(
                        subscription.msg_type, subscription.raw
                    )
                    if taken is not None:
                        subscription.callback(taken[0])
                except Exception as error:  # of one message: the others go on
                    self._failed(describe(error))

    def _ready(self) -> list[Subscription]:
        """Wait for messages: the subscriptions that have some."""
        self._waiting.clear_entities()
        for subscription in self._subscriptions:
            self._waiting.add_subscription(subscription.handle)
        self._waiting.add_guard_condition(self._wake)
        self._waiting.wait(_CONTEXT_PERIOD)
        ready = self._waiting.get_ready_entities("subscription")
        return [item for item in self._subscriptions if item.handle.pointer in ready]
