# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The Python examples of README and docs run, page by page, with what a reader would have."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pages
import pytest

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.motions import steady
from benchmarks.independent.rigs import Mounted, Scene, views
from rs_localizer import data
from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import frame_stamps, simulate_frames
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion

# The reference shows signatures, no examples.
WITH_EXAMPLES = [p for p in pages.NAMES if pages.fenced(p, "python")]
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = rsl.Camera(width=640, height=480, K=K, readout_time=0.03)


@pytest.fixture(scope="module")
def images() -> list[tuple[int, Array, Array]]:
    """Time of the middle row in ns, points and pixels: a second and a half of a hand's motion."""
    motion = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    seen = FrameSettings(points=60, noise=0.5, outliers=0.1)
    stamps = frame_stamps(motion, CAMERA, seen.rate)[600:645]
    way = motion.state(stamps[0], np.linspace(0.0, 1.5, 50)).positions
    frames = simulate_frames(
        CAMERA, motion, room(way, np.random.default_rng(0)), seen, stamps_ns=stamps
    )
    return [(frame.middle_ns, frame.points, frame.pixels) for frame in frames]


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
    lens = np.array(true.distortion)
    camera = rsl.Camera(true.width, true.height, true.matrix, lens, readout_time=true.readout_time)
    return {"camera": camera, "seen": seen}


@pytest.mark.parametrize("page", WITH_EXAMPLES)
def test_examples_run(page, images, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, points, pixels = images[0]
    reader: dict[str, Any] = {
        "K": K, "D": np.zeros(5), "points": points, "pixels": pixels, "camera": CAMERA,
        "images": images,
    }  # fmt: skip
    if page == "docs/rigs.md":
        reader |= opposed()
    for example in pages.fenced(page, "python"):
        exec(compile(example, page, "exec"), reader)
    for check in CHECKS.get(page, []):
        check(SimpleNamespace(**reader))


CHECKS: dict[str, list[Callable[[Any], None]]] = {
    "README.md": [lambda it: _true(isinstance(it.result, rsl.Estimate))],
    "docs/library.md": [
        lambda it: _near(np.median(it.t[:, 0], axis=0), [0.1, 0.0, 0.0], 1e-6),
        lambda it: _true(len(it.path) == len(it.images)),
    ],
    "docs/rigs.md": [
        lambda it: _near(it.result.residuals, 0.0, 1e-3),
        lambda it: _near([it.result.time, it.result.span], [0.0175, 0.035], 1e-12),
        lambda it: _near(np.linalg.norm(it.state.angular_velocity), 1.0, 0.02),
    ],
}


def _true(value: bool) -> None:
    assert value


def _near(value: Any, expected: Any, within: float) -> None:
    np.testing.assert_allclose(value, expected, rtol=0.0, atol=within)
