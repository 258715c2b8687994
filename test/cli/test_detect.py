# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos, folders and bags of rendered prints become recordings of their corners."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main
from rs_localizer.config import DetectorConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.recording import make_camera_info
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.pipeline.images import FrameDetector, correspondences
from rs_localizer.settings import build, load_params_file

K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K)
CALIBRATION = """
image_width: 320
image_height: 240
camera_matrix: {data: [300.0, 0, 159.5, 0, 300.0, 119.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {data: [0, 0, 0, 0, 0]}
"""
SQUARE = 0.03
MARKERS = MarkerMap(wall("5x5_50", (2, 1), 0.07, 0.03), map_frame="hall")  # cells of 1 cm


def render(cells: Any, corners: Any, x: float = 0.0) -> Any:
    """A print of cells (true: white) with corners (4,3), seen from the front and a bit aside."""
    turn = Rotation.from_euler("ZYX", [3.0, 15.0, -10.0], degrees=True).as_matrix()
    seen = (corners @ (turn @ np.diag([1.0, -1.0, -1.0])).T + [x, 0.0, 0.35]) @ K.T
    rows, columns = cells.shape
    drawn = np.kron(np.pad(np.where(cells, 230, 20), 1, constant_values=230), np.ones((20, 20)))
    inner = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]]) + 1.0
    source = (inner * 20 - 0.5).astype(np.float32)
    to_image = cv2.getPerspectiveTransform(source, (seen[:, :2] / seen[:, 2:]).astype(np.float32))
    fine = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1.0]])
    big = cv2.warpPerspective(drawn.astype(np.uint8), fine @ to_image, (1280, 960), borderValue=230)
    return cv2.resize(big, (320, 240), interpolation=cv2.INTER_AREA)


def board(x: float = 0.0) -> Any:
    """A chessboard with 6x4 inner corners."""
    v, u = np.mgrid[:5, :7]
    w, h = 3.5 * SQUARE, 2.5 * SQUARE
    return render((u + v) % 2 == 1, np.array([[-w, h, 0], [w, h, 0], [w, -h, 0], [-w, -h, 0]]), x)


def markers(x: float = 0.0) -> Any:
    """Both markers of the map, in one print."""
    cells = np.ones((7, 17), bool)
    cells[:, :7], cells[:, 10:] = (pattern(m.family, m.id) for m in MARKERS.markers)
    x0, y0 = 0.085, 0.035
    corners = np.array([[-x0, y0, 0], [x0, y0, 0], [x0, -y0, 0], [-x0, -y0, 0]])
    return render(cells, corners, x)


def jpeg(image: Any) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


@pytest.fixture
def files(tmp_path) -> SimpleNamespace:
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    write_marker_map(tmp_path / "map.yaml", MARKERS)
    images = [board(x) for x in (0.0, 0.01, 0.16, 0.02, 5.0, 0.03)]
    (tmp_path / "board.mjpeg").write_bytes(b"".join(map(jpeg, images)))
    return SimpleNamespace(
        video=str(tmp_path / "board.mjpeg"),
        calibration=["--calibration", str(tmp_path / "camera.yaml")],
        board=["--board", "6x4", "--square", str(SQUARE)],
        map=["--map", str(tmp_path / "map.yaml")],
        out=tmp_path / "out",
    )


def detect(files: Any, source: str, *words: str) -> int:
    return main(["detect", source, *words, "--out", str(files.out)])


def clouds(path: Path) -> list[Any]:
    with open_bag(path) as bag:
        return [read_correspondences(m) for _, _, m in bag.messages(["/correspondences"])]


def test_video_of_a_board(files, capsys):
    words = [*files.calibration, *files.board, "--rate", "20", "--images"]
    assert detect(files, files.video, *words, "--readout-time", "0.011") == 0
    # The third image cuts the board off, in the fifth there is none.
    said = capsys.readouterr().out
    assert "4 of 6 images, 24 corners each" in said
    assert f"rs_localizer replay {files.out} --params {files.out}/parameters.yaml" in said
    found = clouds(files.out)
    assert [cloud.stamp_ns for cloud in found] == [
        1_000_000_000 + 50_000_000 * index for index in (0, 1, 3, 5)
    ]
    y, x = np.mgrid[:4, :6] * SQUARE
    for cloud in found:
        # x along the rows of the board, y from row to row, z away from the viewer.
        expected = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
        np.testing.assert_allclose(cloud.points, expected, atol=1e-7)
        np.testing.assert_array_equal(cloud.table["id"], np.arange(24))
    with open_bag(files.out) as bag:
        infos = [m for _, _, m in bag.messages(["/camera_info"])]
        images = [m for _, _, m in bag.messages(["/image/compressed"])]
    assert len(infos) == len(images) == 4
    assert tuple(K.ravel()) == read_camera_info(infos[0]).K
    assert images[0].format == "jpeg"
    # Not compressed twice.
    assert Path(files.video).read_bytes().startswith(images[0].data.tobytes())
    assert build(load_params_file(files.out / "parameters.yaml")).readout_time == 0.011
    # Once more: nothing is overwritten, and it says so in one line.
    assert detect(files, files.video, *words) == 1
    assert capsys.readouterr().err.endswith("exists already; it is not overwritten\n")


def image_bag(path: Path, images: list[Any], info: bool = True) -> None:
    """Raw images, the second one damaged, with the camera's info after the first."""
    with BagWriter(path) as bag:
        for index, image in enumerate(images):
            ns = 10**9 * (index + 5)
            cut = image.tobytes()[: 1000 if index == 1 else None]
            message = make_message(
                "sensor_msgs/msg/Image",
                header=make_camera_info(CAMERA, ns).header,
                height=240,
                width=320,
                encoding="mono8",
                is_bigendian=0,
                step=320,
                data=np.frombuffer(cut, np.uint8),
            )
            bag.write("/cam/image_raw", message, ns)
            if info:
                bag.write("/cam/camera_info", make_camera_info(CAMERA, ns), ns)


def test_bag_of_markers(files, tmp_path, capsys):
    images = [markers(x) for x in (0.0, 0.0, 0.01, 5.0)]
    image_bag(tmp_path / "bag", images)
    (tmp_path / "bag" / "parameters.yaml").write_text(
        "rs_localizer: {ros__parameters: {readout_time: 0.02}}"
    )
    assert detect(files, str(tmp_path / "bag"), *files.map, "--timing") == 0
    said = capsys.readouterr().out
    assert re.search(r"time per image: [\d.]+ ms, of which OpenCV's search took [\d.]+ ms", said)
    assert "2 of 4 images, 8 corners each (median), within 0." in said
    assert "the first one because the data are truncated" in said
    first, second = clouds(files.out)
    assert (first.stamp_ns, second.stamp_ns) == (5 * 10**9, 7 * 10**9)
    assert first.frame == "hall"
    np.testing.assert_array_equal(first.table["id"], np.arange(8))
    np.testing.assert_allclose(first.points, MARKERS.points, atol=1e-7)
    assert build(load_params_file(files.out / "parameters.yaml")).readout_time == 0.02
    # The same bits as the node's own code makes of the message.
    detector = FrameDetector(DetectorConfig(marker_map=files.map[1]))
    with open_bag(tmp_path / "bag") as bag:
        raw = [message for _, _, message in bag.messages(["/cam/image_raw"])]
    node = correspondences(detector.take(raw[0]), make_message)
    with open_bag(files.out) as bag:
        _, _, offline = next(bag.messages(["/correspondences"]))
    assert node.data.tobytes() == offline.data.tobytes()
    assert not detector.take(raw[1])
    assert detector.take(raw[2])


def test_georeferenced_maps_keep_their_millimetres(files, tmp_path):
    # UTM coordinates do not fit into single precision.
    text = Path(files.map[1]).read_text()
    far = text.replace("[-0.05, 0.0, 0.0]", "[691608.001, 5334764.002, 0.0]")
    far = far.replace("[0.05, 0.0, 0.0]", "[691608.101, 5334764.002, 0.0]")
    assert "691608.101" in far
    Path(files.map[1]).write_text(far)
    image_bag(tmp_path / "bag", [markers()])
    assert detect(files, str(tmp_path / "bag"), *files.map) == 0
    (found,) = clouds(files.out)
    assert found.points[0] == pytest.approx([691607.966, 5334764.037, 0.0], abs=1e-6)


def test_nothing_is_left_where_nothing_was_seen(files, tmp_path, capsys):
    other = MarkerMap(wall("5x5_50", (1, 1), 0.1, 0.1, first_id=7))
    write_marker_map(tmp_path / "map.yaml", other)
    image_bag(tmp_path / "bag", [markers()])
    assert detect(files, str(tmp_path / "bag"), *files.map) == 1
    error = capsys.readouterr().err
    assert "none of the 1 images shows anything of the map (5x5_50); they show 5x5_50 0, " in error
    assert not files.out.exists()


def test_settings_are_passed_on(files, tmp_path):
    """The scan direction, and what else calibrate found, not the readout time alone."""
    file = tmp_path / "shutter.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    readout_time: 0.011\n    readout_time_deviation: 0.0002\n"
        "    scan_direction: bottom_to_top\n    imu.time_offset: 0.004\n"
    )
    words = [*files.calibration, *files.board, "--rate", "20", "--params", str(file)]
    assert detect(files, files.video, *words, "-p", "stamp_offset:=0.002") == 0
    config = build(load_params_file(files.out / "parameters.yaml"))
    assert (config.readout_time, config.readout_time_deviation) == (0.011, 0.0002)
    assert (config.scan_direction, config.stamp_offset) == ("bottom_to_top", 0.002)
    assert config.imu.time_offset == 0.004
    # An option of its own counts more; an earlier result is replaced if that is wanted.
    again = [*words, "--scan-direction", "top_to_bottom"]
    assert detect(files, files.video, *again) == 1
    assert detect(files, files.video, *again, "--overwrite") == 0
    config = build(load_params_file(files.out / "parameters.yaml"))
    assert (config.readout_time, config.scan_direction) == (0.011, "top_to_bottom")


def test_a_board_is_known_as_paper_is(files, capsys):
    """0.2 mm in 10 cm, unless a setting says it; the next command still asks for the shutter."""
    words = [*files.calibration, *files.board, "--rate", "20"]
    assert detect(files, files.video, *words) == 0
    y, x = np.mgrid[-1.5:2, -2.5:3] * SQUARE
    paper = 0.002 * np.sqrt(np.mean(x**2 + y**2))
    found = load_params_file(files.out / "parameters.yaml")
    assert found == pytest.approx({"map_deviation": paper})
    said = capsys.readouterr().out
    assert f"--params {files.out}/parameters.yaml --out" in said
    assert "-p readout_time:=SECONDS" in said
    assert detect(files, files.video, *words, "--overwrite", "-p", "map_deviation:=0.0") == 0
    assert load_params_file(files.out / "parameters.yaml") == {"map_deviation": 0.0}
