# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer calibrate --rig`` and ``replay --smooth`` of a simulated pair that never sees the
same, and faults.
"""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters, read_camchain
from rs_localizer.settings import build, load_params_file, write_parameters

K = np.array([[420.0, 0.0, 320.0], [0.0, 422.0, 240.0], [0.0, 0.0, 1.0]])
LENS = [-0.12, 0.04, 0.001, -0.0015]
# The second camera looks back, 10 cm to the right; its stamps are 30 ms late.
AXES = Rotation.from_euler("yx", [175.0, 10.0], degrees=True).as_matrix()
MOVING = "--trajectory tum_vi_room5 --duration 3 --points 60".split()
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
    return recorded(tmp_path_factory.mktemp("pair"), rig, *MOVING)


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
