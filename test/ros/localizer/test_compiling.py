# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first start on a machine: while kernels are compiled, the node answers and says so."""

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters


def said(peer: Any) -> list[tuple[bytes, str]]:
    """Levels and states of the diagnostics, as they come."""
    found: list[tuple[bytes, str]] = []

    def take(message: DiagnosticArray) -> None:
        for status in message.status:
            found.append((status.level, {it.key: it.value for it in status.values}["State"]))

    found_by = peer.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
    assert found_by is not None
    return found


def test_services_answer_while_kernels_are_compiled(start_node, peer, tmp_path):
    states = said(peer)
    node = start_node(XDG_CACHE_HOME=str(tmp_path / "cache"))
    node.wait_for_log("compiling kernels")
    service = "/rs_localizer/get_parameters"
    first = GetParameters.Request(names=["solver"])
    # A few of some hundred are compiled by then.
    while len(list(tmp_path.rglob("*.nbc"))) < 4:
        values = peer.call(GetParameters, service, first).values
        assert [value.string_value for value in values] == ["r6p_vcwt"]
        state = peer.call(GetState, "/rs_localizer/get_state", GetState.Request())
        assert state.current_state.label == "unconfigured"
    # Diagnostics come once a second, and are heard when they have found us.
    assert peer.spin_until(lambda: (b"\1", "compiling") in states)
    assert "kernels are ready" not in node.log
    assert node.stop() == 0
    assert "Traceback" not in node.log


def test_two_clients_configure_at_once(start_node, peer):
    """The transition is made once, and both get an answer."""
    node = start_node("-p", "autostart:=false")
    clients = [peer.node.create_client(ChangeState, "/rs_localizer/change_state") for _ in range(2)]
    assert peer.spin_until(lambda: all(client.service_is_ready() for client in clients))
    peer.spin_until(lambda: False, 0.5)
    request = ChangeState.Request()
    request.transition.id = Transition.TRANSITION_CONFIGURE
    answers = [client.call_async(request) for client in clients]
    assert peer.spin_until(lambda: all(answer.done() for answer in answers))
    assert sorted(answer.result().success for answer in answers) == [False, True]
    assert "is refused: the node is inactive" in node.log
    assert node.stop() == 0
