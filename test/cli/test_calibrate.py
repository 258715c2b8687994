# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer calibrate``, one camera or a rig, and ``replay --smooth``; faults."""

import itertools
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation

from rs_localizer import data
from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.camera_files import read_calibration
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters, read_camchain
from rs_localizer.io.trajectories import read_tum
from rs_localizer.settings import build, load_params_file, write_parameters

MOVING = "--trajectory tum_vi_room5 --duration 3 --points 60 --noise 0.5 --readout-time 0.02"


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "flight"
    assert main(["simulate", str(out), *MOVING.split()]) == 0
    return out


def test_the_webcam(tmp_path, ran):
    """Its images have no times of their own: the readout time is refused, the lens is written."""
    half, out = tmp_path / "half", tmp_path / "webcam.yaml"
    with open_bag(data.path(data.WEBCAM)) as bag, BagWriter(half) as copy:
        for topic, stamp_ns, message in itertools.islice(bag.messages(tuple(bag.topics)), 180):
            copy.write(topic, message, stamp_ns)
    words = ["calibrate", str(half), "--out", str(out), "--intrinsics"]
    said = ran(*words, "--camera-info", tmp_path / "lens.yaml", code=1)
    assert "off their stamps" in said.err
    assert "not written: readout time and scan direction" in said.err
    values = load_params_file(out)
    assert "readout_time" not in values
    camera = read_calibration(out)
    assert camera.K[0, 0] == pytest.approx(529.0, rel=0.02)
    np.testing.assert_allclose(read_calibration(tmp_path / "lens.yaml").D, camera.D)


def test_a_simulated_flight_against_the_assumed_direction(flight, tmp_path, ran):
    """Parts have the sense of the direction that is told: positive."""
    out = tmp_path / "camera.yaml"
    words = ["-p", "scan_direction:=bottom_to_top", "-p", "stamp_offset:=0.001", "--out", str(out)]
    parts = re.findall(r" to +[\d.]+ s +([-+][\d.]+) \+- ", ran("calibrate", flight, *words).out)
    assert parts
    assert all(10.0 < float(part) < 30.0 for part in parts), parts
    values = load_params_file(out)
    assert values["scan_direction"] == "top_to_bottom"
    assert values["stamp_offset"] == 0.001
    assert abs(values["readout_time"] - 0.02) < 4.0 * values["readout_time_deviation"]


def test_an_imu(flight, tmp_path, capsys):
    """Its stamps are 5 ms early."""
    bag, out = tmp_path / "bag", tmp_path / "camera.yaml"
    record(bag, *MOVING.split(), "--imu", "--imu-offset", "0.005")
    assert main(["calibrate", str(bag), "--imu", "--out", str(out)]) == 0
    # 3 s of slow motion
    assert load_params_file(out)["imu.time_offset"] == pytest.approx(5e-3, abs=1e-3)
    said = capsys.readouterr().out
    assert "rotation camera <- imu" in said
    assert "gyroscope bias" in said
    assert main(["calibrate", str(bag), "--imu", "-r", "imu:=/nothing"]) == 1
    assert "/nothing does not exist" in capsys.readouterr().err
    assert main(["calibrate", str(flight), "--imu"]) == 1
    assert "has no topic of type sensor_msgs/msg/Imu" in capsys.readouterr().err


def test_faults(flight, tmp_path, ran):
    video = tmp_path / "video.mjpeg"
    video.write_bytes(2 * cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes())
    board = ["--board", "5x4", "--square", "0.1"]
    for code, words in (
        (1, [str(tmp_path / "none")]), (2, [str(flight), "--out", str(tmp_path / "x.txt")]),
        (2, [str(flight), *board]), (2, [str(video), *board]),
    ):  # fmt: skip
        assert main(["calibrate", *words]) == code
    earlier = tmp_path / "earlier.yaml"
    earlier.write_text("mine")
    lens = tmp_path / "other_camera_info.yaml"
    lens.touch()
    for words, text in (
        (["--out", str(earlier)], f"{earlier} exists; choose another OUT, or --overwrite"),
        (["--out", str(earlier / "a.yaml")], "a.yaml cannot be written: Not a directory"),
        (["--out", str(tmp_path / "other.yaml"), "--camera-info", str(lens)], f"{lens} exists"),
    ):
        told = ran("calibrate", flight, *words, code=1)  # before the work
        assert text in told.err
        assert told.out == ""
    assert earlier.read_text() == "mine"


def test_what_a_lens_is_off_by_stays_with_it(flight, tmp_path):
    """Found with one recording, and the shutter anew with another."""
    lens, both = tmp_path / "lens.yaml", tmp_path / "both.yaml"
    assert main(["calibrate", str(flight), "--intrinsics", "--out", str(lens)]) == 0
    assert main(["calibrate", str(flight), "--camera", str(lens), "--out", str(both)]) == 0
    off = [
        {name: value for name, value in load_params_file(file).items() if "calibration." in name}
        for file in (lens, both)
    ]
    assert len(off[0]) == 4
    assert off[0] == off[1]


def test_smooth(flight, tmp_path, ran):
    out, words = tmp_path / "out", ["replay", str(flight), "--smooth", "--out"]
    params = ["--params", str(flight / "parameters.yaml")]
    assert main([*words, str(out), *params, "--pose-rate", "200"]) == 0
    assert np.diff(read_tum(out / "poses.txt").stamps_ns).min() == pytest.approx(5e6, abs=2)
    assert (out / "bridged.txt").read_text() == ""
    assert "--smooth needs the readout time" in ran(*words, tmp_path / "none", code=1).err


K = np.array([[420.0, 0.0, 320.0], [0.0, 422.0, 240.0], [0.0, 0.0, 1.0]])
LENS = [-0.12, 0.04, 0.001, -0.0015]
# The second camera looks back, 10 cm to the right; its stamps are 30 ms late.
AXES = Rotation.from_euler("yx", [175.0, 10.0], degrees=True).as_matrix()
MOVING_RIG = "--trajectory tum_vi_room5 --duration 3 --points 60".split()
CENTRE, OFFSET = np.array([0.1, -0.02, -0.05]), 0.03


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    return RigParts(
        {
            "front": Camera(640, 480, K, LENS, readout_time=0.02),
            "rear": Camera(640, 480, K, LENS, "plumb_bob", 0.03, "bottom_to_top"),
        },
        {"front": (np.eye(3), np.zeros(3)), "rear": (AXES, -AXES @ CENTRE)},
        {"front": 0.0, "rear": OFFSET},
    )


def recorded(folder, rig, *words):
    write_parameters(folder / "chain.yaml", node_parameters(rig), mounted_lenses(rig))
    record(folder / "pair", "--rig", folder / "chain.yaml", "--noise", "0.3", *words)
    return str(folder / "pair")


@pytest.fixture(scope="module")
def pair(rig, tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("pair"), rig, *MOVING_RIG)


def test_a_pair(pair, tmp_path, ran):
    words = ["--out", str(tmp_path / "rig.yaml"), "-p", "calibration.distortion:=0.75"]
    said = ran("calibrate", "--rig", pair, *words).out
    assert "rear <- front " in said
    values = load_params_file(tmp_path / "rig.yaml")
    config = build(values)
    assert config.cameras == ("front", "rear")
    assert config.calibration.distortion == 0.75  # of a lens that was given
    own = config.of_cameras["rear"]
    assert own.scan_direction == "bottom_to_top"
    assert own.readout_time == pytest.approx(0.03, abs=1e-3)
    assert own.stamp_offset == pytest.approx(OFFSET, abs=1e-3)
    parts = read_camchain(tmp_path / "rig.yaml")
    assert parts.time_offset == {"front": 0.0, "rear": own.stamp_offset}
    assert parts.cameras["rear"].readout_time == own.readout_time
    rotation, translation = parts.camera_from_rig["rear"]
    turned = Rotation.from_matrix(rotation @ AXES.T).magnitude()
    assert np.degrees(turned) < 0.1
    np.testing.assert_allclose(-rotation.T @ translation, CENTRE, atol=5e-3)
    # What the launch file publishes is the same mounting.
    (node,) = ElementTree.parse(tmp_path / "rig_transforms.launch.xml").getroot()
    words = node.get("args").split()
    given = dict(zip(words[::2], words[1::2], strict=True))
    assert given["--frame-id"] == "front_optical_frame"
    assert given["--child-frame-id"] == "rear_optical_frame"
    place = np.array([float(given[f"--{axis}"]) for axis in "xyz"])
    turn = Rotation.from_quat([float(given[f"--q{axis}"]) for axis in "xyzw"])
    np.testing.assert_allclose(place, -rotation.T @ translation, atol=1e-12)
    np.testing.assert_allclose(turn.as_matrix(), rotation.T, atol=1e-12)
    # The file alone tells replay the cameras, their shutters and their lenses.
    words = ["--camera", str(tmp_path / "rig.yaml"), "--out", str(tmp_path / "poses")]
    assert "tracked from the frame before" in ran("replay", pair, *words).out


def test_an_even_motion_determines_nothing(rig, tmp_path, capsys):
    words = "--duration 1 --points 40 --angular-velocity 0 0 0 --linear-velocity 0 0 0".split()
    pair = recorded(tmp_path, rig, *words)
    assert main(["calibrate", "--rig", pair, "--out", str(tmp_path / "rig.yaml")]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert "front: not observable" in line
    assert "rear: not observable" in line
    assert not (tmp_path / "rig.yaml").exists()


def test_faults_are_named_before_anything_is_read(pair, tmp_path, ran):
    missing, lens = tmp_path / "rear.mp4", tmp_path / "lens_rear.yaml"
    lens.touch()
    out = ["--out", str(tmp_path / "rig.yaml"), "--camera-info", str(tmp_path / "lens.yaml")]
    for words, text in (([pair, str(missing)], f"{missing} does not exist"),
                        ([pair, *out], f"{lens} exists")):  # fmt: skip
        said = ran("calibrate", "--rig", *words, code=1)
        assert text in said.err
        assert said.out == ""


def test_smoothed_frames_are_nearer_to_the_truth(pair, tmp_path, capsys):
    settings = ["--params", str(Path(pair) / "parameters.yaml"), "-p", "pose_time:=mid_frame"]
    errors = []
    for name, words in (("plain", []), ("smooth", ["--smooth"])):
        out = str(tmp_path / name)
        assert main(["replay", pair, *settings, *words, "--out", out]) == 0
        capsys.readouterr()
        assert main(["evaluate", out, pair, "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out)["result"])
    plain, smooth = errors
    assert plain["poses"] == smooth["poses"]
    for quantity in ("position_median_m", "orientation_median_deg"):
        assert smooth[quantity] < 0.9 * plain[quantity]
    # Of one of the two plain frames the twist is unknown: it would be 0.5 m/s off.
    assert smooth["linear_velocity_p95_m_per_s"] < 0.05
    assert smooth["angular_velocity_p95_deg_per_s"] < 4.0
