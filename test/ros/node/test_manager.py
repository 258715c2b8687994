# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The live node under nav2's lifecycle manager: its order of requests, and its bond."""

import importlib.util
import time
from typing import Any

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import JointState

from rs_localizer.ros.node.conversion import message_class

from ..conftest import RUN  # noqa: TID252 - Python has a package "test"

INSTALLED = importlib.util.find_spec("bond") is not None
# The messages of bond are not on PyPI. A JointState carries their fields where there are none.
_STAND_IN = """
import sys, types
from sensor_msgs.msg import JointState
def init(self, id, instance_id, active, heartbeat_timeout, heartbeat_period):
    JointState.__init__(self, name=[id, instance_id], position=[float(active), heartbeat_timeout])
module = types.ModuleType("bond.msg")
module.Status = type("JointState", (JointState,), {"__init__": init,
    "__module__": JointState.__module__})
sys.modules |= {"bond": types.ModuleType("bond"), "bond.msg": module}
"""
BOND_TIMEOUT = 4.0  # nav2's default
# A request that has no answer by then (s) is lost: the manager would wait for ever.
LOST = 120.0
ORDER = {
    Transition.TRANSITION_CONFIGURE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    Transition.TRANSITION_DEACTIVATE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_CLEANUP: State.PRIMARY_STATE_UNCONFIGURED,
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: State.PRIMARY_STATE_FINALIZED,
}
STARTUP = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
RESET = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)


class Manager:
    """Does what nav2_lifecycle_manager does (branch jazzy, f4108e5), with one node.

    It waits until both services are there. Then it sends each request once: the transition, and
    the question whether its state has come. A bond has to form in half of its timeout after the
    activation, and is broken by the node's last word or its silence.
    """

    def __init__(self, peer: Any) -> None:
        self._peer = peer
        self._clients = {
            kind: peer.node.create_client(kind, f"rs_localizer/{name}")
            for kind, name in ((ChangeState, "change_state"), (GetState, "get_state"))
        }
        self.instances: list[str] = []  # of bonds that formed
        self.gap, self._heard, self._alive = 0.0, 0.0, False
        self._bond: Any = None

    def _call(self, kind: Any, request: Any) -> Any:
        client = self._clients[kind]
        assert self._peer.spin_until(client.service_is_ready, LOST)
        answer = client.call_async(request)
        assert self._peer.spin_until(answer.done, LOST), f"no answer to {request}"
        return answer.result()

    def change(self, *transitions: int) -> None:
        for transition in transitions:
            request = ChangeState.Request(transition=Transition(id=transition))
            assert self._call(ChangeState, request).success
            state = self._call(GetState, GetState.Request()).current_state.id
            assert state == ORDER[transition]
            if transition == Transition.TRANSITION_ACTIVATE:
                self._form()
            elif transition == Transition.TRANSITION_DEACTIVATE:
                # The node has said that it leaves: nobody has to wait for the timeout.
                assert self._peer.spin_until(lambda: not self._alive, BOND_TIMEOUT / 2)
                self._peer.node.destroy_subscription(self._bond)

    def _form(self) -> None:
        kind = message_class("bond/msg/Status") if INSTALLED else JointState
        self.gap, self._heard = 0.0, time.monotonic()
        self._bond = self._peer.node.create_subscription(kind, "bond", self._hear, 30)
        assert self._peer.spin_until(lambda: self._alive, BOND_TIMEOUT / 2), "no bond"

    def _hear(self, status: Any) -> None:
        if INSTALLED:
            name, instance, active = status.id, status.instance_id, status.active
        else:
            (name, instance), (active, _) = status.name, status.position
        assert name == "rs_localizer"
        self.gap = max(self.gap, time.monotonic() - self._heard)
        self._heard, self._alive = time.monotonic(), bool(active)
        if instance not in self.instances:
            self.instances.append(instance)

    def watch(self, seconds: float) -> None:
        """Watch the bond, which must not break."""
        assert not self._peer.spin_until(lambda: not self._alive, seconds)
        assert self.gap < BOND_TIMEOUT


def test_nav2_starts_pauses_resets_and_shuts_down_the_node(start_node, peer):
    run = RUN if INSTALLED else _STAND_IN + RUN
    node = start_node("-p", "autostart:=false", "-p", "readout_time:=0.02", run=run)
    manager = Manager(peer)
    manager.change(*STARTUP)
    manager.watch(1.0)
    # Paused and resumed; a bond must not be taken for the one before.
    manager.change(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)
    manager.watch(1.0)
    manager.change(*RESET, *STARTUP)
    assert len(manager.instances) == 3
    manager.change(*RESET, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert node.stop() == 0
    assert "Traceback" not in node.log
    assert "bond_timeout 0.0" not in node.log  # which it says where the package is missing
