# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos, folders and bags of rendered prints, or of anything, become recordings for replay."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from recorded import imu, tf
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.config import DetectorConfig, FeatureConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences, read_keypoints
from rs_localizer.io.images import read_image
from rs_localizer.io.recording import make_camera_info
from rs_localizer.io.trajectories import read_motions
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.pipeline.keypoints import FrameExtractor, keypoints
from rs_localizer.pipeline.marker_detector import FrameDetector, correspondences
from rs_localizer.settings import load_params_file

from ..markers.prints import K, chessboard_cells, rectangle, render  # noqa: TID252 - Python has a package "test"

CAMERA = Camera(320, 240, K)
LENS = "1 PINHOLE 320 240 300 300 160 120\n"  # the first pixel's middle is at 0.5
SQUARE, DEPTH = 0.03, 0.45
TURN = Rotation.from_euler("YX", [25.0, -20.0], degrees=True).as_matrix()  # camera_from_print
MARKERS = MarkerMap(wall("5x5_50", (2, 1), 0.07, 0.03), map_frame="hall")


def seen(prints: Any, x: float) -> Any:
    """Prints whose middle is before the camera, or x m beside it; of the map y is up."""
    return render(prints, (TURN @ np.diag([1.0, -1.0, -1.0]), np.array([x, 0.0, DEPTH])))


def board(columns: int = 6, rows: int = 4, x: float = 0.0) -> Any:
    width, height = columns + 1, rows + 1
    outline = rectangle(SQUARE * width, SQUARE * height)
    return seen([(chessboard_cells(width, height), outline)], x)


def markers(x: float = 0.0) -> Any:
    return seen([(pattern(m.family, m.id), m.corners) for m in MARKERS.markers], x)


@pytest.fixture
def here(tmp_path) -> SimpleNamespace:
    (tmp_path / "cameras.txt").write_text(LENS)
    write_marker_map(tmp_path / "map.yaml", MARKERS)
    # The third image cuts the board off, in the fifth there is none.
    images = [board(x=x) for x in (0.0, 0.01, 0.25, 0.02, 5.0, 0.03)]
    jpegs = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1] for image in images]
    (tmp_path / "board.mjpeg").write_bytes(b"".join(jpeg.tobytes() for jpeg in jpegs))
    return SimpleNamespace(
        path=tmp_path,
        out=tmp_path / "out",
        video=str(tmp_path / "board.mjpeg"),
        calibration=("--calibration", str(tmp_path / "cameras.txt")),
        board=("--board", "6x4", "--square", str(SQUARE)),
        map=("--map", str(tmp_path / "map.yaml")),
    )


def detect(here: Any, source: Any, *words: str) -> int:
    return main(["detect", str(source), *words, "--out", str(here.out)])


def folder(path: Path, images: list[Any]) -> str:
    path.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(path / f"{k:04}.png"), image)
    return str(path)


def raw(pixels: Any, ns: int) -> Any:
    header = make_camera_info(CAMERA, ns, "eye").header
    return make_message(
        "sensor_msgs/msg/Image", header=header, height=240, width=320, encoding="mono8",
        is_bigendian=0, step=320, data=pixels.ravel(),
    )  # fmt: skip


def image_bag(path: Path, images: list[Any]) -> list[Any]:
    """Raw images from 5 s on, the second one damaged, with the camera's info."""
    messages = [raw(image, 10**9 * (k + 5)) for k, image in enumerate(images)]
    with BagWriter(path) as bag:
        for k, message in enumerate(messages):
            if k == 1:
                message.data = message.data[:1000]
            ns = 10**9 * (k + 5)
            bag.write("/cam/camera_info", make_camera_info(CAMERA, ns, "eye"), ns)
            bag.write("/cam/image_raw", message, ns)
    return messages


def topic(path: Path, name: str) -> list[Any]:
    with open_bag(path) as bag:
        return [message for _, _, message in bag.messages([name])]


def clouds(path: Path) -> list[Any]:
    return [read_correspondences(message) for message in topic(path, "/correspondences")]


def settings(here: Any) -> dict[str, Any]:
    return load_params_file(here.out / "parameters.yaml")


def test_video_of_a_board(here, capsys):
    words = [*here.calibration, *here.board, "--rate", "20", "--images"]
    assert detect(here, here.video, *words, "-p", "readout_time:=0.011") == 0
    said = capsys.readouterr().out
    assert "4 of 6 images, 24 corners each" in said
    assert f"rs_localizer replay {here.out} --params {here.out}/parameters.yaml" in said
    found = clouds(here.out)
    assert [cloud.stamp_ns for cloud in found] == [
        1_000_000_000 + 50_000_000 * index for index in (0, 1, 3, 5)
    ]
    y, x = np.mgrid[:4, :6] * SQUARE
    for cloud in found:
        # x along the rows of the board, y from row to row, z away from the viewer.
        expected = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
        np.testing.assert_allclose(cloud.points, expected, atol=1e-7)
        np.testing.assert_array_equal(cloud.table["id"], np.arange(24))
    infos, images = topic(here.out, "/camera_info"), topic(here.out, "/image/compressed")
    assert len(infos) == len(images) == 4
    assert tuple(K.ravel()) == read_camera_info(infos[0]).K
    kept = cv2.imdecode(np.asarray(images[0].data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(kept.astype(int) - board()).mean() < 2.0  # of 255, by two compressions
    # A board is known as paper is: 0.2 mm in 10 cm.
    paper = 0.002 * np.sqrt(np.mean((x - x.mean()) ** 2 + (y - y.mean()) ** 2))
    assert settings(here) == pytest.approx({"map_deviation": paper, "readout_time": 0.011})
    # Nothing is overwritten without being asked; the next command asks for the shutter.
    assert detect(here, here.video, *words) == 1
    assert capsys.readouterr().err.endswith("exists; choose another OUT, or --overwrite\n")
    assert detect(here, here.video, *words, "--overwrite", "-p", "map_deviation:=0.0") == 0
    assert "-p readout_time:=SECONDS" in capsys.readouterr().out
    assert settings(here) == {"map_deviation": 0.0}


def test_bag_of_markers(here, capsys):
    bag = here.path / "bag"
    messages = image_bag(bag, [markers(x) for x in (0.0, 0.0, 0.01, 5.0)])
    (bag / "parameters.yaml").write_text("rs_localizer: {ros__parameters: {readout_time: 0.02}}")
    assert detect(here, bag, *here.map) == 0
    said = capsys.readouterr().out
    assert "2 of 4 images, 8 corners each (median), within 0." in said
    assert "the first one because the data are truncated" in said
    first, second = clouds(here.out)
    assert (first.stamp_ns, second.stamp_ns) == (5 * 10**9, 7 * 10**9)
    assert first.frame == "hall"
    np.testing.assert_array_equal(first.table["id"], np.arange(8))
    np.testing.assert_allclose(first.points, MARKERS.points, atol=1e-7)
    assert settings(here)["readout_time"] == 0.02
    # The same bits as the node's own code makes of the message.
    detector = FrameDetector(DetectorConfig(marker_map=here.map[1]))
    node = correspondences(detector.detect(read_image(messages[0])), make_message)
    assert bytes(node.data) == bytes(topic(here.out, "/correspondences")[0].data)


@pytest.mark.parametrize(("kind", "width"), [("orb", 32), ("sift", 128)])
def test_keypoints_of_anything(here, kind, width, capsys):
    noise = np.random.default_rng(0).integers(0, 256, (4, 240, 320), np.uint8)
    images = [cv2.GaussianBlur(each, (0, 0), 2.0) for each in noise]
    messages = image_bag(here.path / "bag", [*images, np.zeros((240, 320), np.uint8)])
    words = ["--features", kind, "--max-keypoints", "40", "-p", "readout_time:=0.02"]
    assert detect(here, here.path / "bag", *words) == 0
    said = capsys.readouterr().out
    assert re.search(rf"out: 3 of 5 images, \d\d keypoints \({kind}\) each \(median\)", said)
    assert f"parameters.yaml --out {here.out}_poses --map MAP" in said
    # As the node does it, to the last bit.
    extractor = FrameExtractor(FeatureConfig(features=kind, max_keypoints=40))
    found = topic(here.out, "/keypoints")
    for message, cloud in zip([messages[k] for k in (0, 2, 3)], found, strict=True):
        live = keypoints(extractor.detect(read_image(message)), make_message)
        assert bytes(cloud.data) == bytes(live.data)
        assert repr((cloud.header, cloud.fields)) == repr((live.header, live.fields))
        descriptors = read_keypoints(cloud).descriptors
        assert descriptors is not None
        assert descriptors.shape == (cloud.width, width)
    assert len(topic(here.out, "/camera_info")) == 3


def test_georeferenced_maps_keep_their_millimetres(here):
    # UTM coordinates do not fit into single precision.
    path = here.path / "map.yaml"
    far = path.read_text().replace("[-0.05, 0.0, 0.0]", "[691608.001, 5334764.002, 0.0]")
    path.write_text(far.replace("[0.05, 0.0, 0.0]", "[691608.101, 5334764.002, 0.0]"))
    image_bag(here.path / "bag", [markers()])
    assert detect(here, here.path / "bag", *here.map) == 0
    (found,) = clouds(here.out)
    assert found.points[0] == pytest.approx([691607.966, 5334764.037, 0.0], abs=1e-6)


def test_what_is_seen_instead_is_named(here, capsys):
    """Other markers; another board; nothing is left of the result."""
    write_marker_map(here.path / "map.yaml", MarkerMap(wall("5x5_50", (1, 1), 0.1, 0, first_id=7)))
    image_bag(here.path / "bag", [markers()])
    assert detect(here, here.path / "bag", *here.map) == 1
    shows = "none of the 1 images shows anything of the map (5x5_50); they show 5x5_50 0, "
    assert shows in capsys.readouterr().err
    images = folder(here.path / "images", [board(7, 5)] * 6)
    assert detect(here, images, *here.calibration, *here.board, "--rate", "30") == 1
    said = capsys.readouterr().err
    shows = r"shows anything of the map \(chessboard 6x4\); are these its inner corners"
    assert re.search(f"detect: none of the 6 images {shows}", said)
    assert not here.out.exists()


def test_one_marker_tells_nothing_of_the_calibration(here, capsys):
    """Any lens leaves as little of its four corners."""
    write_marker_map(here.path / "map.yaml", MarkerMap(MARKERS.markers[:1]))
    image_bag(here.path / "bag", [markers()])
    assert detect(here, here.path / "bag", *here.map) == 0
    assert "1 of 1 images, 4 corners each (median)\n" in capsys.readouterr().out


def test_a_wrong_calibration_is_named(here, capsys):
    (here.path / "cameras.txt").write_text(LENS.replace("300 300", "300 900"))
    images = folder(here.path / "images", [board()] * 3)
    assert detect(here, images, *here.calibration, *here.board, "--rate", "30") == 0
    said = capsys.readouterr().out
    assert re.search(r"warning: even the stillest images leave \d+\.\d px rms: the calib", said)


def test_motion_during_the_readout_is_no_fault_of_the_calibration(here, capsys):
    """Each row of an image is half a pixel beside the one above; the next image is 100 px off."""
    images = [
        cv2.warpAffine(
            board(x=0.075 * side), np.array([[1.0, 0.5 * side, -60.0 * side], [0, 1, 0]]),
            (320, 240), borderMode=cv2.BORDER_REPLICATE,
        )
        for side in (1, -1) * 3
    ]  # fmt: skip
    source = folder(here.path / "images", images)
    assert detect(here, source, *here.calibration, *here.board, "--rate", "30") == 0
    said = capsys.readouterr().out
    assert float(re.search(r"within (\S+) px rms of a global-shutter pose", said)[1]) > 1.5
    assert "warning" not in said


@pytest.mark.parametrize(("first", "last", "code"), [(0, 1, 0), (5, 6, 0), (0, 12, 1)])
def test_images_of_another_size_are_left_out_or_named(here, first, last, code, capsys):
    boards = [board(x=0.001 * k) for k in range(12)]
    boards[first:last] = [cv2.resize(image, (160, 120)) for image in boards[first:last]]
    images = folder(here.path / "images", boards)
    assert detect(here, images, *here.calibration, *here.board, "--rate", "10") == code
    said = capsys.readouterr()
    if code:
        assert "is of 160x120, the calibration is for 320x240" in said.err
        return
    assert "11 of 12 images" in said.out
    assert re.search(r"left out, .* because the image at [\d.]+ s is of 160x120", said.out)


@pytest.mark.parametrize("own_calibration", [True, False])
def test_transforms_and_imu_of_a_bag_are_kept(here, own_calibration, capsys):
    start, still = 100 * 10**9, Rotation.identity()  # the recorder's clock is another one
    with BagWriter(here.path / "bag") as bag:
        bag.write("/tf_static", tf("base_link", "eye", (0.0, 0.0, 2.0), still, 5), start)
        for k in range(6):
            stamp = 10**9 + 33_000_000 * k
            info = make_camera_info(CAMERA, stamp, "eye")
            png = cv2.imencode(".png", board(x=0.001 * k))[1].ravel()
            image = make_message(
                "sensor_msgs/msg/CompressedImage", header=info.header, format="png", data=png
            )
            wheel = tf("base_link", "wheel", (0.0, 0.0, 2.0), still, 5)
            bag.write("/camera_info", info, start + stamp)
            bag.write("/image", image, start + stamp)
            bag.write("/imu/data", imu(stamp), start + stamp + 7)
            bag.write("/tf", wheel, start + stamp)
    calibration = here.calibration if own_calibration else ()
    assert detect(here, here.path / "bag", *calibration, *here.board) == 0
    assert "kept for replay: /tf_static (1), " in capsys.readouterr().out
    counts = [len(topic(here.out, name)) for name in ("/tf_static", "/tf", "/imu/data")]
    assert counts == [1, 6, 6]
    with open_bag(here.out) as bag:
        times = [ns for _, ns, _ in bag.messages(["/imu/data", "/correspondences"])]
    assert times == sorted(times)
    assert times[1] - times[0] == 7
    assert (here.out / "metadata.yaml").read_text().count("durability: transient_local") == 1
    # The camera hangs where the recording has it: 2 m before the body, along its own axis.
    poses = here.path / "poses"
    words = ["-p", "base_frame:=base_link", "-p", "readout_time:=0.02", "--out", str(poses)]
    assert main(["replay", str(here.out), *words]) == 0
    found = read_motions(poses).poses.positions
    first_corner = np.array([0.0, 0.0, DEPTH]) - TURN @ [2.5 * SQUARE, 1.5 * SQUARE, 0.0]
    expected = -TURN.T @ (first_corner + 2.0 * np.eye(3)[2])
    np.testing.assert_allclose(np.median(found, axis=0), expected, atol=0.05)
