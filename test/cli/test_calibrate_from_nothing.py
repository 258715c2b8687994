# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A film of a board and nothing else: lens, readout time and direction, against a small renderer
that is the test's own (rays through a distorted lens, three by three in a pixel, row by row).
"""

import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import read_calibration
from rs_localizer.io.trajectories import read_tum
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.settings import load_params_file

WIDTH, HEIGHT, FOCAL, CENTRE = 320, 240, 290.0, (161.5, 117.0)
K1, K2 = -0.12, 0.05
READOUT, RATE, SECONDS = 0.02, 30.0, 3.0
LENS = Camera(
    WIDTH, HEIGHT, [[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]], [K1, K2, 0, 0]
)
COLUMNS, ROWS, SQUARE = 9, 6, 0.03  # inner corners, m
BOARD = ("--board", f"{COLUMNS}x{ROWS}", "--square", str(SQUARE))
WITHIN = (np.arange(3) + 0.5) / 3.0 - 0.5  # of a pixel


def rays() -> np.ndarray:
    """Rays (HEIGHT, WIDTH, 9, 3) through each pixel: the distortion undone by iteration."""
    v, u, b, a = np.meshgrid(
        np.arange(HEIGHT), np.arange(WIDTH), WITHIN, WITHIN, indexing="ij", sparse=True
    )
    x, y = np.broadcast_arrays((u + a - CENTRE[0]) / FOCAL, (v + b - CENTRE[1]) / FOCAL)
    left, up = x.copy(), y.copy()
    for _ in range(12):
        r2 = left**2 + up**2
        scale = 1.0 + K1 * r2 + K2 * r2**2
        left, up = x / scale, y / scale
    out = np.stack([left, up, np.ones_like(left)], axis=-1)
    return out.reshape(HEIGHT, WIDTH, 9, 3).astype(np.float32)


def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """board_from_camera rotations (n,3,3) and camera centres (n,3): a hand that looks at it."""
    tilt = np.column_stack([0.4 * np.sin(2.9 * t), 0.45 * np.sin(2.1 * t + 1.0),
                            0.3 * np.sin(3.7 * t + 2.0)])  # fmt: skip
    shake = np.column_stack([0.03 * np.sin(9.1 * t), 0.03 * np.sin(7.7 * t + 2.0),
                             0.05 * np.sin(8.3 * t)])  # fmt: skip
    # Slow at the beginning, for a first lens.
    pace = np.clip(t / 1.5, 0.0, 1.0)[:, None] ** 2
    around = Rotation.from_rotvec(tilt)
    distance = 0.36 + 0.05 * np.sin(1.7 * t)
    centre = around.apply(np.column_stack([0.0 * t, 0.0 * t, -distance]))
    return (around * Rotation.from_rotvec(pace * shake)).as_matrix(), centre


def expose(stamp: float, through: np.ndarray) -> np.ndarray:
    """The image (HEIGHT, WIDTH) whose first row is exposed at ``stamp``."""
    rotations, centres = pose(stamp + READOUT * np.arange(HEIGHT) / (HEIGHT - 1))
    image = np.empty((HEIGHT, WIDTH), np.uint8)
    for row in range(HEIGHT):
        turned = through[row].reshape(-1, 3) @ rotations[row].T.astype(np.float32)
        scale = -centres[row, 2] / turned[:, 2]
        x = (centres[row, 0] + scale * turned[:, 0]) / SQUARE + (COLUMNS - 1) / 2
        y = (centres[row, 1] + scale * turned[:, 1]) / SQUARE + (ROWS - 1) / 2
        column, line = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
        board = (column >= -1) & (column < COLUMNS) & (line >= -1) & (line < ROWS)
        light = np.where(board & ((column + line) % 2 == 0), 20.0, 220.0)
        image[row] = np.rint(light.reshape(WIDTH, 9).mean(axis=1))
    return image


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    folder, through = tmp_path_factory.mktemp("film"), rays()
    rng = np.random.default_rng(0)
    for stamp in np.arange(0.0, SECONDS, 1.0 / RATE):
        image = expose(float(stamp), through) + rng.normal(0.0, 2.0, (HEIGHT, WIDTH))
        name = folder / f"{1_700_000_000_000_000_000 + round(1e9 * stamp)}.png"
        cv2.imwrite(str(name), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return folder


def paste_next(said: str) -> str:
    """Run what comes next as it is printed, and as each command says in its turn."""
    (line,) = [row for row in said.splitlines() if row.startswith("next: ")]
    for command in line.removeprefix("next: ").split(" && "):
        _, words = command.split("rs_localizer ", 1)
        assert main(shlex.split(words)) == 0
    return line


def test_a_film_gives_lens_readout_time_and_direction(film, tmp_path, capsys):
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(film), *BOARD, "--out", str(out)]) == 0
    values = load_params_file(out)
    error = abs(values["readout_time"] - READOUT)
    assert error < 4.0 * values["readout_time_deviation"] < 1e-3
    assert values["scan_direction"] == "top_to_bottom"
    camera = read_calibration(out)
    assert camera.K[[0, 1], [0, 1]] == pytest.approx([FOCAL, FOCAL], rel=0.01)
    assert camera.K[:2, 2] == pytest.approx(CENTRE, abs=3.0)
    # What the distortion does half way to the rim, rather than its coefficients.
    r2 = np.array([0.1, 0.2])
    found = camera.D[0] * r2 + camera.D[1] * r2**2
    assert found == pytest.approx(K1 * r2 + K2 * r2**2, abs=0.005)
    said = capsys.readouterr().out
    line = paste_next(said)
    assert "camera_map.yaml" in line
    # The board's shape was measured: better known than that of any paper (0.1 m rms: 0.2 mm).
    measured = read_marker_map(tmp_path / "camera_map.yaml").settings["map_deviation"]
    assert values["map_deviation"] == pytest.approx(measured, 0.01)
    assert 0.0 < measured < 2e-4
    assert f"--camera {out}" in line
    poses = read_tum(tmp_path / "camera_poses" / "poses.txt")
    assert len(poses.positions) > 0.9 * SECONDS * RATE
