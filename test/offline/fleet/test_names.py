# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Folders of results: a recording's own name, and never the same twice."""

import random
from pathlib import Path

import pytest

from rs_localizer.offline.fleet.identity import folder_names


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["/a/flight", "/a/drive.mcap"], ["flight", "drive"]),
        (["/a/flight", "/b/flight", "/b/other"], ["a_flight", "b_flight", "other"]),
        (["/a/x/flight", "/b/x/flight"], ["a_x_flight", "b_x_flight"]),
        (["/flight", "/b/flight"], ["flight", "b_flight"]),
        (["/a/one.mcap", "/a/one.db3"], ["a_one.mcap", "a_one.db3"]),
    ],
)
def test_parents_tell_those_of_one_name_apart(paths, names):
    assert folder_names([Path(path) for path in paths]) == names


def test_all_names_differ_and_are_names():
    rng = random.Random(0)
    parts = ["a", "b", "a_b", "b.x"]
    for _ in range(300):
        paths = {Path("/", *rng.choices(parts, k=rng.randint(1, 4))) for _ in range(12)}
        names = folder_names(list(paths))
        assert len(set(names)) == len(paths)
        assert all(name and "/" not in name for name in names)
