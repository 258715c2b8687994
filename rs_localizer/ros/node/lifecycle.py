"""A life cycle that no request of a client and no failing callback can end."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.msg import State, Transition
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode
from rclpy.task import Future

from rs_localizer.ros.node.worker import in_thread

_ON_CHANGE_STATE = "_LifecycleNodeMixin__on_change_state"


class RobustLifecycleNode(LifecycleNode):
    """A managed node that answers impossible transitions instead of raising.

    Before it is configured, a thread compiles what it needs (see :meth:`prepare`), which takes up
    to a minute at the first start on a machine; services and diagnostics answer meanwhile.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._prepared: Future | None = None
        self.compiles = True  # what it prepares; otherwise it loads what has been compiled
        # A request to configure waits; others shall not wait for it.
        group = ReentrantCallbackGroup()
        for service in self.services:
            service.callback_group = group
            group.add_entity(service)

    def kernels(self) -> Callable[[], None]:
        """What compiles the kernels of the present settings, to be called in another thread."""
        raise NotImplementedError

    @property
    def state(self) -> str:
        """Label of the present state; ``compiling`` or ``loading`` while kernels are prepared."""
        label: str = self._state_machine.current_state[1]
        if self._prepared is not None and not self._prepared.done() and label == "unconfigured":
            return "compiling" if self.compiles else "loading"
        return label

    def prepare(self) -> Future:
        """Compile in a thread; the result is what failed, or empty."""
        if self._prepared is None or self._prepared.done():
            self._prepared = prepared = Future()
            compiles = self.kernels()
            in_thread(lambda: prepared.set_result(_failure(compiles)))
        return self._prepared

    def configure(self, failure: str) -> bool:
        """Configure after :meth:`prepare`, if nobody else has; whether that worked."""
        if failure:
            self.get_logger().error(f"not configured:\n{failure}")
            return False
        if self._unconfigured():
            self.trigger_configure()
        return not self._unconfigured()

    def _unconfigured(self) -> bool:
        return bool(self._state_machine.current_state[0] == State.PRIMARY_STATE_UNCONFIGURED)

    # rclpy (7.x, Jazzy) lets the error of a transition that the present state does not have out of
    # the service's callback: the client waits for ever and the executor stops. This is the name,
    # private to its class, under which it registers the callback; where there is none of this name
    # the override does nothing, and the node's loop still survives the error.
    async def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        wanted = request.transition.label or request.transition.id
        if wanted in ("configure", Transition.TRANSITION_CONFIGURE) and self._unconfigured():
            failure = await self.prepare()
            if failure:
                response.success = self.configure(failure)
                return response
        try:
            return getattr(super(), _ON_CHANGE_STATE)(request, response)
        except RuntimeError:  # RCLError; what callbacks raise does not come here
            _, present = self._state_machine.current_state
            self.get_logger().warning(f"transition {wanted} is refused: the node is {present}")
            response.success = False
            return response


def _failure(function: Callable[[], None]) -> str:
    try:
        function()
    except Exception:
        return traceback.format_exc()
    return ""
