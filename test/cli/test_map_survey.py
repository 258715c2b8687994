# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map survey`` on images of the test's own: flat prints, warped one by one."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.calibration import write_calibration
from rs_localizer.markers.map_files import read_marker_map

WIDTH, HEIGHT, FOCAL, SIZE, CELL = 320, 240, 260.0, 0.12, 12
K = np.array([[FOCAL, 0.0, 158.0], [0.0, FOCAL, 121.0], [0.0, 0.0, 1.0]])
# map_from_marker: before the camera, tilted; y up is -y of a camera.
PRINTS = [
    (Rotation.from_rotvec(tilt).as_matrix() @ np.diag([1.0, -1.0, -1.0]), np.array(place))
    for tilt, place in (
        ((0.3, 0.2, 0.0), (-0.22, 0.02, 0.9)),
        ((-0.2, -0.5, 0.1), (0.0, -0.05, 1.0)),
        ((0.1, 0.4, -0.2), (0.24, 0.06, 0.95)),
    )
]


def picture(turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    """What a global shutter sees from a pose map_from_camera, drawn twice as large and halved."""
    fine = np.full((2 * HEIGHT, 2 * WIDTH), 120, np.uint8)
    # The centre of the first pixel is at 0, 0 in both.
    doubled = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, (axes, middle) in enumerate(PRINTS):
        side = 8 * CELL
        sheet = np.full((side, side), 235, np.uint8)
        draw = getattr(cv2.aruco, "generateImageMarker", None) or cv2.aruco.drawMarker  # OpenCV 4.6
        sheet[CELL:-CELL, CELL:-CELL] = draw(dictionary, number, 6 * CELL).clip(25, 235)
        texel = SIZE / (6 * CELL)
        corner = middle + axes @ (0.5 * (1 - side) * texel * np.array([1.0, -1.0, 0.0]))
        plane = np.column_stack([axes[:, 0] * texel, -axes[:, 1] * texel, corner - place])
        cv2.warpPerspective(
            sheet, doubled @ K @ turn.T @ plane, fine.shape[::-1], fine,
            cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT,
        )  # fmt: skip
    return cv2.resize(fine, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    """A second of images, with the calibration beside them."""
    folder = tmp_path_factory.mktemp("walk")
    (folder / "images").mkdir()
    for k in range(30):
        t = k / 30.0
        turn = Rotation.from_rotvec([0.1 * np.sin(5 * t), 0.15 * np.sin(4 * t), 0.2 * t])
        place = np.array([0.3 * np.sin(3 * t), 0.2 * np.sin(4 * t + 1), 0.15 * np.cos(5 * t)])
        cv2.imwrite(str(folder / f"images/{k:03d}.png"), picture(turn.as_matrix(), place))
    write_calibration(folder / "camera.yaml", Camera(width=WIDTH, height=HEIGHT, K=K))
    return folder


def survey(walk: Path, out: Path, *more: str) -> int:
    return main([
        "map", "survey", str(walk / "images"), "--calibration", str(walk / "camera.yaml"),
        "--rate", "30", "--family", "4x4_50", "--size", str(SIZE), "--out", str(out), *more,
    ])  # fmt: skip


@pytest.mark.parametrize("deviations", ["shape", "origin"])
def test_markers_of_images_are_found(walk, tmp_path, deviations, capsys):
    out = tmp_path / "wall.yaml"
    assert survey(walk, out, "--deviations", deviations) == 0
    said = capsys.readouterr().out
    assert "images with a marker     30 of 30" in said
    assert "frame: that of marker 4x4_50 0, whose own orientation is known to" in said
    found = read_marker_map(out).markers
    assert [marker.id for marker in found] == [0, 1, 2]
    turn, origin = PRINTS[0]
    for marker, (axes, middle) in zip(found, PRINTS, strict=True):
        np.testing.assert_allclose(marker.pose.position, turn.T @ (middle - origin), atol=0.004)
        off = Rotation.from_matrix(marker.pose.rotation.T @ turn.T @ axes).magnitude()
        assert np.degrees(off) < 1.0
        assert marker.deviations is not None
    held = found[0].deviations
    assert held is not None
    assert np.all(held == 0.0) == (deviations == "origin")


def test_a_readout_time_that_the_images_contradict_is_refused(walk, tmp_path, capsys):
    out, wrong = tmp_path / "wall.yaml", ("-p", "readout_time:=0.006")
    assert survey(walk, out, *wrong) == 1
    error = capsys.readouterr().err
    assert "6.0 ms was given" in error
    assert "with --keep-readout-time it is written all the same" in error
    assert not out.exists()
    assert survey(walk, out, *wrong, "--keep-readout-time") == 0
    assert "warning: estimated readout time is" in capsys.readouterr().out
    assert out.exists()
