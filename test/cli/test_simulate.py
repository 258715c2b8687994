"""The bag of `simulate`: what it holds, and that its truth is the truth of its frames."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.estimates import read_motions
from rs_localizer.io.messages import stamp_ns
from rs_localizer.settings import load_params_file

CLEAN = ("--noise", "0", "--outliers", "0", "--points", "60")
TURN = ("--angular-velocity", "0.5", "-1", "2", "--linear-velocity", "1", "0.5", "0")


def simulate(out: Path, *words: str) -> int:
    return main(["simulate", str(out), *words])


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bag_holds_frames_and_their_truth(tmp_path: Path, storage: str) -> None:
    words = ("--duration", "0.5", "--storage", storage, "--readout-time", "0.02")
    assert simulate(tmp_path / "bag", *words) == 0
    with open_bag(tmp_path / "bag") as bag:
        assert bag.topics == {
            "/camera_info": "sensor_msgs/msg/CameraInfo",
            "/correspondences": "sensor_msgs/msg/PointCloud2",
            "/truth/pose": "geometry_msgs/msg/PoseStamped",
            "/truth/twist": "geometry_msgs/msg/TwistStamped",
        }
        messages = list(bag.messages(bag.topics))
    counts = Counter(topic for topic, _, _ in messages)
    assert messages[0][0] == "/camera_info"  # or the first frame would be lost
    frames = counts["/correspondences"]
    assert frames == 15
    assert counts == {
        "/camera_info": frames, "/correspondences": frames,
        "/truth/pose": 2 * frames, "/truth/twist": 2 * frames,
    }  # fmt: skip
    clouds = [m for topic, _, m in messages if topic == "/correspondences"]
    stamps = [stamp_ns(m) for m in clouds]
    assert stamps[0] == 1_000_000_000
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 30, atol=2)
    # At the first row and at the middle one, so that either pose_time has its exact truth.
    truth = {stamp_ns(m) for topic, _, m in messages if topic == "/truth/pose"}
    assert truth == set(stamps) | {stamp + 10_000_000 for stamp in stamps}
    assert {m.header.frame_id for t, _, m in messages if t == "/truth/pose"} == {"map"}
    cameras = {m.header.frame_id for t, _, m in messages if t in ("/truth/twist", "/camera_info")}
    assert cameras == {"camera_optical_frame"}
    assert clouds[0].header.frame_id == "map"
    assert len(set(read_correspondences(clouds[0]).table["id"])) == 150


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_each_row_sees_the_points_from_its_own_true_pose(tmp_path: Path, direction: str) -> None:
    """At constant velocity the truth between two stamps is known from their poses and twists."""
    words = (*CLEAN, *TURN, "--duration", "0.4", "--scan-direction", direction)
    lens = ("--distortion", "-0.2", "0.05", "0.001", "-0.001")
    assert simulate(tmp_path / "bag", *words, *lens) == 0
    truth = read_motions(tmp_path / "bag", "/truth/pose", "/truth/twist")
    assert truth.twists is not None
    with open_bag(tmp_path / "bag") as bag:
        messages = list(bag.messages(["/camera_info", "/correspondences"]))
    camera = read_camera_info(messages[0][2]).camera(0.03, direction)
    np.testing.assert_array_equal(camera.D, [-0.2, 0.05, 0.001, -0.001])
    for _, _, message in messages[1::2]:
        cloud = read_correspondences(message)
        row = truth.poses.stamps_ns.tolist().index(cloud.stamp_ns)
        angular, linear = truth.twists.angular[row], truth.twists.linear[row]
        start = Rotation.from_quat(truth.poses.quaternions[row])
        along = cloud.pixels[:, 1] / 479 if "top" in direction else 1 - cloud.pixels[:, 0] / 639
        late = 0.03 * along[:, None]
        turned = start * Rotation.from_rotvec(late * angular)
        centres = truth.poses.positions[row] + late * start.apply(linear)
        seen = camera.project(turned.inv().apply(cloud.points - centres))
        np.testing.assert_allclose(seen, cloud.pixels, atol=1e-3)  # float32 in the message


def test_twist_is_the_derivative_of_the_pose(tmp_path: Path) -> None:
    words = ("--trajectory", "tum_vi_room5", "--start", "20", "--duration", "1")
    assert simulate(tmp_path / "bag", *words, "--readout-time", "0.0002") == 0
    truth = read_motions(tmp_path / "bag", "/truth/pose", "/truth/twist")
    assert truth.twists is not None
    # First row and middle row are 0.1 ms apart.
    rotations = Rotation.from_quat(truth.poses.quaternions)
    angular = (rotations[0::2].inv() * rotations[1::2]).as_rotvec() / 1e-4
    np.testing.assert_allclose(truth.twists.angular[0::2], angular, atol=5e-3)
    travel = (truth.poses.positions[1::2] - truth.poses.positions[0::2]) / 1e-4
    linear = rotations[0::2].inv().apply(travel)
    np.testing.assert_allclose(truth.twists.linear[0::2], linear, atol=2e-3)
    assert np.linalg.norm(angular, axis=1).max() > 2.0
    # The camera looks along the rig's x axis, and its z axis is up.
    assert np.all(rotations.apply([0.0, 1.0, 0.0])[:, 2] < -0.5)


def test_gaps_of_the_recording_stay_gaps(tmp_path: Path) -> None:
    t = np.arange(0.0, 2.0, 0.01)
    t = t[(t < 0.8) | (t > 1.2)]
    lines = [f"{1.5e9 + s:.9f} {s} 0 0 0 0 0 1\n" for s in t]
    (tmp_path / "poses.txt").write_text("".join(lines))
    assert simulate(tmp_path / "bag", "--trajectory", str(tmp_path / "poses.txt")) == 0
    truth = read_motions(tmp_path / "bag", "/truth/pose", "/truth/twist")
    seconds = (truth.poses.stamps_ns - 1_500_000_000_000_000_000) * 1e-9
    assert not np.any((seconds > 0.79 + 1e-6) & (seconds < 1.21 - 1e-6))
    assert seconds.min() < 0.1
    assert seconds.max() > 1.9


def test_same_seed_same_bag(tmp_path: Path) -> None:
    def pixels(name: str, seed: str) -> np.ndarray:
        assert simulate(tmp_path / name, "--duration", "0.1", "--seed", seed) == 0
        with open_bag(tmp_path / name) as bag:
            (first, *_) = (message for _, _, message in bag.messages(["/correspondences"]))
        return np.asarray(first.data)

    one, same, other = pixels("a", "3"), pixels("b", "3"), pixels("c", "4")
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["--trajectory", "absent.txt"], 1, "absent.txt does not exist"),
        (["--trajectory", "tum_vi_room5", "--linear-velocity", "1", "0", "0"], 2, "not both"),
        (["--outliers", "1.5"], 2, "--outliers: must lie between 0 and 1, got 1.5"),
        (["--distortion", "0.1"], 2, "--distortion: plumb_bob takes 0 or 4 or 5 coefficients"),
        (["--distortion", "0.1", "nan"], 2, "--distortion: must be a number, got 'nan'"),
        (["--focal", "0"], 2, "--focal: must be more than 0, got 0"),
        (["--width", "0"], 2, "--width: must be 2 or more, got 0"),
        (["--height", "-5"], 2, "--height: must be 2 or more, got -5"),
        (["--noise", "-1"], 2, "--noise: must be 0 or more, got -1"),
        (["--noise", "inf"], 2, "--noise: must be a number, got 'inf'"),
        (["--points", "0"], 2, "--points: must be 1 or more, got 0"),
        (["--seed", "-1"], 2, "--seed: must be 0 or more, got -1"),
        (["--start", "-1"], 2, "--start: must be 0 or more, got -1"),
        (["--duration", "nan"], 2, "--duration: must be a number, got 'nan'"),
        (["--duration", "0"], 2, "--duration: must be more than 0, got 0"),
        (["--knot-spacing", "-1"], 2, "--knot-spacing: must be 0 or more, got -1"),
        (["--readout-time", "0.3"], 2, "--readout-time: must lie between 0 and 0.2, got 0.3"),
        (["--linear-velocity", "1", "x", "0"], 2, "--linear-velocity: must be a number, got 'x'"),
        (["--focal", "1e7"], 1, "none of the 300 frames sees any point"),
        (["--duration", "0.001"], 1, "no frame lies within"),
        (["--rate", "0"], 2, "--rate: must be more than 0, got 0"),
        (["--scan-direction", "up"], 2, "invalid choice: 'up'"),
        (["--points", "many"], 2, "--points: must be a whole number, got 'many'"),
    ],
)
def test_faults(
    tmp_path: Path,
    words: list[str],
    code: int,
    expected: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert simulate(tmp_path / "bag", *words) == code
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()
    assert not (tmp_path / "bag").exists()


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate(tmp_path / "bag", "--duration", "0.1") == 0
    assert simulate(tmp_path / "bag", "--duration", "0.1") == 1
    assert "exists already" in capsys.readouterr().err


def test_the_next_command_has_the_shutter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("--readout-time", "0.025", "--scan-direction", "bottom_to_top", "--duration", "0.2")
    assert simulate(Path("my bag"), *words) == 0
    *_, line = capsys.readouterr().out.splitlines()
    label, program, *command = shlex.split(line)
    assert (label, program) == ("next:", "rs_localizer")
    assert load_params_file(tmp_path / "my bag" / "parameters.yaml") == {
        "readout_time": 0.025,
        "scan_direction": "bottom_to_top",
    }
    assert main(command) == 0
    assert main(["evaluate", "my bag_poses", "my bag"]) == 0


def test_fewer_points_than_asked_for_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Two seconds at a narrow view of a room: some frames see a point, others none.
    words = ("--focal", "30000", "--points", "5", "--duration", "2")
    assert simulate(tmp_path / "bag", *words) == 0
    line = capsys.readouterr().out.splitlines()[0]
    found = re.search(
        r"(\d) points each \(of 5 asked for; (\d+) frames see fewer, (\d+) of them none\)$", line
    )
    assert found, line
    with open_bag(tmp_path / "bag") as bag:
        widths = [message.width for _, _, message in bag.messages(["/correspondences"])]
    assert int(found[2]) == sum(width < 5 for width in widths) > int(found[3]) > 0
    assert int(found[3]) == widths.count(0)
    assert simulate(tmp_path / "full", "--duration", "0.1") == 0
    assert "asked for" not in capsys.readouterr().out


def test_help_shows_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--help"]) == 0
    text = capsys.readouterr().out
    for default in ("640", "480", "500.0", "plumb_bob", "0.03", "top_to_bottom", "30.0", "150"):
        assert f"(default: {default})" in text
