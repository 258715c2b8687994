"""A rendered board video becomes a recording of its corners."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.core.so3 import Array
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.lab.board_video import main, record_board
from rs_localizer.lab.boards import Board, find_corners
from rs_localizer.lab.video import Image
from rs_localizer.settings import build, load_params_file

BOARD = Board(columns=6, rows=4, square=0.03)
K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K)
CALIBRATION = """
image_width: 320
image_height: 240
camera_matrix: {data: [300.0, 0, 159.5, 0, 300.0, 119.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {data: [0, 0, 0, 0, 0]}
"""
# Pixels per square of the drawn board, and how finely an image is rendered before it is shrunk.
_DRAWN, _FINE = 40, 4


def pose(roll: float = 0.0, x: float = 0.0) -> tuple[Array, Array]:
    """Rotation (3,3) and translation (3,) camera_from_board of a board in front, turned by roll."""
    rotation = Rotation.from_euler("ZYX", [roll, 15.0, -10.0], degrees=True).as_matrix()
    centre = BOARD.points.mean(axis=0)
    return rotation, np.array([x, 0.0, 0.35]) - rotation @ centre


def render(rotation: Array, translation: Array) -> Image:
    """The image of the board, with a white rim of one square."""
    y, x = np.mgrid[: BOARD.rows + 3, : BOARD.columns + 3]
    squares = np.where((x + y) % 2, 255, 30)
    squares[[0, -1], :], squares[:, [0, -1]] = 255, 255
    drawn = np.kron(squares, np.ones((_DRAWN, _DRAWN))).astype(np.uint8)
    # From drawn pixels to board metres: the first inner corner is two squares inside.
    scale = BOARD.square / _DRAWN
    offset = (0.5 - 2 * _DRAWN) * scale
    board_from_drawn = np.array([[scale, 0, offset], [0, scale, offset], [0, 0, 1.0]])
    plane = np.column_stack([rotation[:, :2], translation])
    # Pixel centres of the fine image: p_fine = FINE p + (FINE - 1)/2.
    fine = np.array([[_FINE, 0, (_FINE - 1) / 2], [0, _FINE, (_FINE - 1) / 2], [0, 0, 1.0]])
    size = (_FINE * CAMERA.width, _FINE * CAMERA.height)
    big = cv2.warpPerspective(
        drawn, fine @ K @ plane @ board_from_drawn, size, borderValue=255, flags=cv2.INTER_LINEAR
    )
    return np.asarray(cv2.resize(big, (320, 240), interpolation=cv2.INTER_AREA), np.uint8)


def project(rotation: Array, translation: Array) -> Array:
    return CAMERA.project(BOARD.points @ rotation.T + translation)


def write_video(path: Path, poses: list[tuple[Array, Array]]) -> None:
    images = [cv2.imencode(".jpg", render(*p), [cv2.IMWRITE_JPEG_QUALITY, 98])[1] for p in poses]
    path.write_bytes(b"".join(image.tobytes() for image in images))


def test_corners_are_where_they_were_rendered() -> None:
    for roll in (-40.0, 0.0, 25.0):
        found = find_corners(render(*pose(roll)), BOARD)
        assert found is not None
        errors = found - project(*pose(roll))
        assert np.abs(errors).max() < 0.12  # the squares are 25 px wide
        assert np.abs(errors.mean(axis=0)).max() < 0.02


def test_order_is_kept_through_a_full_turn() -> None:
    previous = None
    for roll in range(0, 360, 15):
        previous = find_corners(render(*pose(float(roll))), BOARD, previous)
        assert previous is not None
        np.testing.assert_allclose(previous, project(*pose(float(roll))), atol=0.15)


def test_first_order_reads_as_text() -> None:
    upside_down = find_corners(render(*pose(180.0)), BOARD)
    assert upside_down is not None
    np.testing.assert_allclose(upside_down, project(*pose(180.0))[::-1], atol=0.12)


def test_recording_has_the_corners_of_the_whole_boards(tmp_path: Path) -> None:
    # The third image cuts the board off, in the fifth there is none.
    offsets = [0.0, 0.01, 0.16, 0.02, 5.0, 0.03]
    poses = [pose(3.0 * index, x) for index, x in enumerate(offsets)]
    write_video(tmp_path / "board.mjpeg", poses)
    recorded = record_board(tmp_path / "board.mjpeg", CAMERA, BOARD, tmp_path / "bag", rate=20.0)
    assert (recorded.images, recorded.skipped) == (6, 2)
    assert recorded.residual < 0.1

    with open_bag(tmp_path / "bag") as bag:
        infos = list(bag.messages(["/camera_info"]))
        clouds = [read_correspondences(m) for _, _, m in bag.messages(["/correspondences"])]
        images = [m for _, _, m in bag.messages(["/image/compressed"])]
    assert [cloud.stamp_ns for cloud in clouds] == [
        1_000_000_000 + 50_000_000 * index for index in (0, 1, 3, 5)
    ]
    for cloud, index in zip(clouds, (0, 1, 3, 5), strict=True):
        np.testing.assert_allclose(cloud.points, BOARD.points, atol=1e-7)
        np.testing.assert_allclose(cloud.pixels, project(*poses[index]), atol=0.12)
        np.testing.assert_array_equal(cloud.table["id"], np.arange(24))
    assert len(infos) == len(images) == 4
    assert tuple(K.ravel()) == read_camera_info(infos[0][2]).K
    assert images[0].format == "jpeg"
    stream = (tmp_path / "board.mjpeg").read_bytes()
    assert stream.startswith(images[0].data.tobytes())  # not compressed twice


def run(tmp_path: Path, *extra: str) -> int:
    words = ["--calibration", str(tmp_path / "camera.yaml"), "--board", "6x4", "--square", "0.03"]
    return main([str(tmp_path / "board.mjpeg"), *words, "--rate", "30", *extra])


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(tmp_path / "board.mjpeg", [pose(), pose(x=0.16)])
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    out = ["--out", str(tmp_path / "bag")]
    assert run(tmp_path, *out, "--no-images", "--readout-time", "0.011") == 0
    assert "1 of 2 images, 1 skipped" in capsys.readouterr().out
    with open_bag(tmp_path / "bag") as bag:
        assert sorted(bag.topics) == ["/camera_info", "/correspondences"]
    assert build(load_params_file(tmp_path / "bag" / "parameters.yaml")).readout_time == 0.011
    # Once more: nothing is overwritten, and it says so in one line.
    assert run(tmp_path, *out) == 1
    assert capsys.readouterr().err == f"{tmp_path / 'bag'} exists already; it is not overwritten\n"


def test_faults_end_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(tmp_path / "board.mjpeg", [pose(x=5.0)])
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    out = ["--out", str(tmp_path / "bag")]
    assert run(tmp_path, *out) == 1
    assert "none of the 1 images" in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()
    (tmp_path / "camera.yaml").write_text(CALIBRATION.replace("240", "480"))
    assert run(tmp_path, *out) == 1
    assert "images of 320x240, the calibration is for 320x480" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--square", "0"), "--square: must be more than 0, got 0"),
        (("--square", "-1"), "--square: must be more than 0, got -1"),
        (("--rate", "0"), "--rate: must be more than 0, got 0"),
        (("--readout-time", "7"), "--readout-time: must lie between 0 and 0.2, got 7"),
        (("--board", "1x1"), "--board: a board needs 3x3 inner corners, got 1x1"),
        (("--board", "six"), "--board must be of the form 6x4, got 'six'"),
    ],
)
def test_wrong_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], text: str
) -> None:
    with pytest.raises(SystemExit) as end:
        run(tmp_path, "--out", str(tmp_path / "bag"), *words)
    assert end.value.code == 2
    assert text in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
