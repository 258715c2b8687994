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
CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
PAUSE, RESET = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP
END = Transition.TRANSITION_UNCONFIGURED_SHUTDOWN
STATES = {
    CONFIGURE: State.PRIMARY_STATE_INACTIVE, ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    PAUSE: State.PRIMARY_STATE_INACTIVE, RESET: State.PRIMARY_STATE_UNCONFIGURED,
    END: State.PRIMARY_STATE_FINALIZED,
}  # fmt: skip


class Bond:
    """One end of a bond, as nav2's manager listens to the node's."""

    def __init__(self, node: Any) -> None:
        self.instances: list[str] = []
        self.is_alive, self.gap, self._heard = False, 0.0, 0.0
        kind = message_class("bond/msg/Status") if INSTALLED else JointState
        node.create_subscription(kind, "bond", self._hear, 30)

    def _hear(self, status: Any) -> None:
        if INSTALLED:
            name, instance, active = status.id, status.instance_id, status.active
        else:
            (name, instance), (active, _) = status.name, status.position
        assert name == "rs_localizer"
        now = time.monotonic()
        if self.is_alive:
            self.gap = max(self.gap, now - self._heard)
        self._heard, self.is_alive = now, bool(active)
        if instance not in self.instances:
            self.instances.append(instance)


def test_nav2_starts_pauses_resets_and_shuts_down_the_node(start_node, peer):
    """As nav2_lifecycle_manager does it (branch jazzy, f4108e5), with one node.

    It waits until both services are there, then sends each request once: the transition, and the
    question whether its state has come. A bond has to form in half of its timeout after the
    activation, and is broken by the node's last word or its silence.
    """
    run = RUN if INSTALLED else _STAND_IN + RUN
    node = start_node("-p", "autostart:=false", "-p", "readout_time:=0.02", run=run)
    services = ((ChangeState, "change_state"), (GetState, "get_state"))
    clients = {k: peer.node.create_client(k, f"rs_localizer/{name}") for k, name in services}
    bond = Bond(peer.node)

    def ask(kind: Any, request: Any) -> Any:
        assert peer.spin_until(clients[kind].service_is_ready, LOST)
        answer = clients[kind].call_async(request)
        assert peer.spin_until(answer.done, LOST), f"no answer to {request}"
        return answer.result()

    def change(*transitions: int) -> None:
        for transition in transitions:
            request = ChangeState.Request(transition=Transition(id=transition))
            assert ask(ChangeState, request).success
            assert ask(GetState, GetState.Request()).current_state.id == STATES[transition]
            # When it pauses the node says that it leaves: nobody has to wait for the timeout.
            alive = transition == ACTIVATE
            assert peer.spin_until(lambda alive=alive: bond.is_alive == alive, BOND_TIMEOUT / 2)

    change(CONFIGURE, ACTIVATE)
    assert not peer.spin_until(lambda: not bond.is_alive, 1.0)
    # Paused and resumed; a bond must not be taken for the one before.
    change(PAUSE, ACTIVATE)
    assert not peer.spin_until(lambda: not bond.is_alive, 1.0)
    change(PAUSE, RESET, CONFIGURE, ACTIVATE)
    assert len(bond.instances) == 3
    assert bond.gap < BOND_TIMEOUT
    change(PAUSE, RESET, END)
    assert node.stop() == 0
    assert "Traceback" not in node.log
    assert "bond_timeout 0.0" not in node.log  # which it says where the package is missing
