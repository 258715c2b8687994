# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The fault matrix: what is wrong, what the node says of it, and that it localizes afterwards.

A fault is a row of :data:`FAULTS`. The table is written to a file with

    RS_LOCALIZER_FAULTS=out/faults.md .venv/bin/python -m pytest test/ros/localizer/faults
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fault_events import bug
from fault_table import FAULTS
from live_world import PATIENCE, World, record


@pytest.fixture(scope="module")
def worlds(tmp_path_factory) -> Iterator[list[World]]:
    """The faults share one; after one that failed, it is a new one."""
    recording = record(tmp_path_factory.mktemp("bags") / "flight")
    worlds = [World(recording)]
    yield worlds
    worlds[-1].close()


@pytest.fixture
def world(worlds, request) -> Iterator[World]:
    failed = request.session.testsfailed
    yield worlds[-1]
    if request.session.testsfailed > failed:
        worlds[-1].close()
        worlds.append(World(worlds[-1].recording))


@pytest.fixture(scope="module")
def matrix() -> Iterator[list[tuple[str, str, str]]]:
    """The rows of the table: fault, what the node said, whether it localized afterwards."""
    found: list[tuple[str, str, str]] = []
    yield found
    if path := os.environ.get("RS_LOCALIZER_FAULTS"):
        lines = ["| fault | the node | localized afterwards |", "|---|---|---|"]
        lines += [f"| {name} | {said} | {after} |" for name, said, after in found]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault(world, matrix, fault):
    seen, poses = len(world.said), len(world.peer.poses)
    result = fault.do(world)
    answers = [result] if isinstance(result, str) else []

    def spoken() -> str:
        found = [text for text in [*answers, *world.said[seen:]] if re.search(fault.says, text)]
        return found[0] if found else ""

    def done() -> bool:
        if fault.pose and len(world.peer.poses) == poses:
            return False
        return bool(spoken()) or not fault.says

    for _ in range(20):
        if not isinstance(result, str):
            world.send(*result)
        if world.until(done, PATIENCE if isinstance(result, str) else 2.0):
            break
    assert done(), world.said[seen:]
    before = len(world.said)
    assert world.localizes(), world.said[before:]
    internal = [text for text in world.said[seen:] if text.startswith("internal_error")]
    assert len(internal) == (fault.do is bug)
    said = next((line for line in spoken().splitlines() if re.search(fault.says, line)), "")
    row = f"localizes it; {said}" if fault.pose else said or "refuses it"
    matrix.append((fault.name, row.removesuffix("; "), "yes"))
