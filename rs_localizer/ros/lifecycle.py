"""A life cycle that no request of a client and no failing callback can end."""

from __future__ import annotations

from typing import Any

from rclpy.lifecycle import LifecycleNode


class RobustLifecycleNode(LifecycleNode):
    """A managed node that answers impossible transitions instead of raising."""

    # rclpy (7.x, Jazzy) lets the error of a transition that the present state does not have out of
    # the service's callback: the client waits for ever and the executor stops. This is the name,
    # private to its class, under which it registers the callback; where there is none of this name
    # the override does nothing, and the node's loop still survives the error.
    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except RuntimeError:  # RCLError; what callbacks raise does not come here
            wanted = request.transition.label or request.transition.id
            _, present = self._state_machine.current_state
            self.get_logger().warning(f"transition {wanted} is refused: the node is {present}")
            response.success = False
            return response
