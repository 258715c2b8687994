# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The Python examples of README and docs run, page by page, with what a reader would have."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pages
import pytest

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.motions import steady
from benchmarks.independent.rigs import Mounted, Scene, views
from rs_localizer.core.arrays import Array
from rs_localizer.tools.simulation.scene import room

from ..moving import PLAIN, Moving, camera_of, recorded_hand  # noqa: TID252 - package "test"

# The reference shows signatures, no examples.
WITH_EXAMPLES = [p for p in pages.NAMES if pages.fenced(p, "python")]
CAMERA = camera_of(PLAIN)


@pytest.fixture(scope="module")
def images() -> list[tuple[int, Array, Array]]:
    """Time of the middle row in ns, points and pixels: a second and a half of a hand's motion."""
    way, states = recorded_hand()
    hand, rng = Moving(way), np.random.default_rng(0)
    world = room(states.positions[190:230], rng, count=1500)
    times = 20.0 + np.arange(45) / 30.0
    return [(round(1e9 * t), *hand.frame(t, world, 60, 0.5, 0.1)) for t in times]


def opposed() -> dict[str, Any]:
    """A camera, and what the rig of docs/rigs.md sees: the second one upside down, 5 ms later."""
    true, rng = TrueCamera(), np.random.default_rng(0)
    places = {"up": (np.eye(3), np.zeros(3), 0.0)}
    places["down"] = np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.0]), 0.005
    rig = {name: Mounted(true, *place) for name, place in places.items()}
    made = views(rig, steady(1, rng, 1.0, 0.5), np.zeros(1), 60, Scene.WALL, rng)
    seen = {
        name: (view.points[0, view.visible[0]], view.exact[0, view.visible[0]])
        for name, view in made.items()
    }
    return {"camera": camera_of(true), "seen": seen}


@pytest.mark.parametrize("page", WITH_EXAMPLES)
def test_examples_run(page, images, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, points, pixels = images[0]
    reader: dict[str, Any] = {
        "K": CAMERA.K, "D": np.zeros(5), "points": points, "pixels": pixels, "camera": CAMERA,
        "images": images,
    }  # fmt: skip
    if page == "docs/rigs.md":
        reader |= opposed()
    for example in pages.fenced(page, "python"):
        exec(compile(example, page, "exec"), reader)
    found = SimpleNamespace(**reader)
    if page == "README.md":
        assert isinstance(found.result, rsl.Estimate)
    elif page == "docs/library.md":
        np.testing.assert_allclose(np.median(found.t[:, 0], axis=0), [0.1, 0.0, 0.0], atol=1e-6)
        assert len(found.path) == len(images)
    elif page == "docs/rigs.md":
        np.testing.assert_allclose(found.result.residuals, 0.0, atol=1e-3)
        assert (found.result.time, found.result.span) == pytest.approx((0.0175, 0.035))
        assert np.linalg.norm(found.state.angular_velocity) == pytest.approx(1.0, abs=0.02)
