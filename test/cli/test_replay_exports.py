# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses at any row, and transforms.json: both say where the camera saw the points."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.neural_reconstruction import NerfstudioError, sequence, transforms
from rs_localizer.io.trajectories import read_tum

READOUT = 0.03
MOVING = ("--angular-velocity", "0.4", "1", "-0.3", "--linear-velocity", "0.5", "0.2", "0.3")
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> SimpleNamespace:
    path = tmp_path_factory.mktemp("exports") / "flight"
    words = ["--duration", "0.3", "--noise", "0.1", "--points", "150", *MOVING]
    assert main(["simulate", str(path), *words, "--readout-time", str(READOUT)]) == 0
    with open_bag(path) as bag:
        clouds = [read_correspondences(m) for _, _, m in bag.messages(["/correspondences"])]
    return SimpleNamespace(
        path=path, params=("--params", str(path / "parameters.yaml")),
        clouds={cloud.stamp_ns: cloud for cloud in clouds},
    )  # fmt: skip


def replay(flight: Any, out: Path, *words: str) -> int:
    return main(["replay", str(flight.path), *flight.params, "--out", str(out), *words])


@pytest.mark.parametrize("more", [(), ("--smooth",), ("-p", "pose_time:=mid_frame")])
def test_poses_at_rows(flight, tmp_path, more):
    out = tmp_path / "out"
    rows = ["--row", "first", "--row", "middle", "--row", "last", "--row", "0.25"]
    assert replay(flight, out, *rows, *more) == 0
    plain = read_tum(out / "poses.txt")
    taus = {"first": -0.5, "middle": 0.0, "last": 0.5, "0.25": 0.25}
    for name, tau in taus.items():
        found = read_tum(out / f"poses_{name}.txt")
        stamps = sorted(flight.clouds)
        assert len(found) == len(plain) == len(stamps)
        seconds = READOUT * (tau + 0.5)  # from the stamp, which is the first row's
        np.testing.assert_allclose((found.stamps_ns - stamps) * 1e-9, seconds, atol=2e-9)
        # What this row shows is where the pose of its exposure puts it.
        errors = []
        for stamp, position, quaternion in zip(
            stamps, found.positions, found.quaternions, strict=True
        ):
            cloud = flight.clouds[stamp]
            near = np.abs(cloud.pixels[:, 1] / 479 - 0.5 - tau) < 0.02
            turn = Rotation.from_quat(quaternion).as_matrix()
            seen = (cloud.points[near] - position) @ turn @ K.T
            errors += list(np.linalg.norm(seen[:, :2] / seen[:, 2:] - cloud.pixels[near], axis=1))
        assert len(errors) > 10
        assert np.median(errors) < 0.8  # in these rows the image moves by 1 px
    reference = "middle" if "pose_time:=mid_frame" in more else "first"
    same = read_tum(out / f"poses_{reference}.txt")
    np.testing.assert_allclose(same.positions, plain.positions, atol=1e-9)
    assert replay(flight, out, "--overwrite") == 0
    assert not (out / "poses_last.txt").exists()


def test_places_are_checked_before_the_work(flight, tmp_path, capsys):
    """Once said after the replay, whose poses were then gone; a table replaced any file."""
    out, splat = tmp_path / "out", tmp_path / "splat"
    notes, table = tmp_path / "notes.txt", tmp_path / "new" / "frames.parquet"
    notes.write_text("mine")
    exports = ["--gsplat", str(splat), "--parquet", str(table)]
    assert replay(flight, out, *exports) == 0
    before = (splat / "viewmats.npy").read_bytes(), table.read_bytes()
    for words, text in (
        (["--gsplat", str(splat)], "splat exists; choose another --gsplat"),
        (["--parquet", str(notes), "--overwrite"], "notes.txt is no earlier result of --parquet"),
        (["--ncore", str(tmp_path / "other" / "ncore")], "has to be a directory beside"),
        (["--parquet", str(notes / "a.parquet")], "a.parquet cannot be written: Not a directory"),
        (["--rerun", str(notes / "a.rrd")], "a.rrd cannot be written: Not a directory"),
        (["--parquet", "nosuch://a/b.parquet"], "b.parquet cannot be written: Protocol not known"),
    ):
        capsys.readouterr()
        assert replay(flight, tmp_path / "other", *words) == 1
        told = capsys.readouterr()
        assert text in told.err
        assert "frames per second" not in told.out
        assert not (tmp_path / "other").exists()
    assert notes.read_text() == "mine"
    (splat / "viewmats.npy").write_bytes(b"")
    assert replay(flight, out, *exports, "--overwrite") == 0
    assert ((splat / "viewmats.npy").read_bytes(), table.read_bytes()) == before


def test_transforms_explain_every_pixel(flight, tmp_path):
    out = tmp_path / "out"
    assert replay(flight, out, "--nerfstudio") == 0
    told = json.loads((out / "transforms.json").read_text())
    assert (told["camera_model"], told["w"], told["h"]) == ("OPENCV", 640, 480)
    assert (told["fl_x"], told["cx"], told["cy"]) == (500.0, 320.0, 240.0)
    assert len(told["frames"]) == len(flight.clouds)
    for frame in told["frames"]:
        cloud = flight.clouds[int(Path(frame["file_path"]).stem)]
        pose = np.array(frame["transform_matrix"])
        u, v = cloud.pixels.T + 0.5
        seconds = (v / told["h"] - 0.5) * told["rolling_shutter_time"]
        turns = Rotation.from_rotvec(np.outer(seconds, frame["camera_angular_velocity"]))
        moved = pose[:3, 3] + np.outer(seconds, pose[:3, :3] @ frame["camera_linear_velocity"])
        # Axes of OpenGL: x right, y up, the camera looks along -z.
        x, y, z = turns.inv().apply((cloud.points - moved) @ pose[:3, :3]).T
        seen = told["fl_x"] * x / -z + told["cx"], told["fl_y"] * -y / -z + told["cy"]
        assert np.median(np.hypot(seen[0] - u, seen[1] - v)) < 0.25


def seen_between(start: Any, end: Any, camera: dict[str, Any], point: Any, shutter: str) -> Any:
    """Pixel (2,) of a point as gsplat and NCore project it, by camera_from_map at both ends.

    Both interpolate quaternion and translation by floor(row) / (rows - 1), of pixels whose first
    one has its corner at 0, 0; in the middle of a row that is (row - 1/2) / (rows - 1).
    """
    (width, height), focal, centre = camera["size"], camera["focal"], camera["centre"]
    slerp = Slerp([0.0, 1.0], Rotation.from_matrix([start[:3, :3], end[:3, :3]]))
    pixel = np.array([width, height]) / 2
    for _ in range(20):  # the row decides the pose, the pose the row
        x, y = (pixel - 0.5) / (width - 1, height - 1)
        time = {
            "ROLLING_TOP_TO_BOTTOM": y, "ROLLING_BOTTOM_TO_TOP": 1.0 - y,
            "ROLLING_LEFT_TO_RIGHT": x, "ROLLING_RIGHT_TO_LEFT": 1.0 - x,
        }[shutter]  # fmt: skip
        moved = (1.0 - time) * start[:3, 3] + time * end[:3, 3]
        x, y, z = slerp(np.clip(time, 0.0, 1.0)).apply(point) + moved
        pixel = focal * (x / z, y / z) + centre
    return pixel


@pytest.mark.parametrize(
    ("direction", "more"),
    [
        ("top_to_bottom", ()), ("bottom_to_top", ("--smooth",)),
        ("left_to_right", ("-p", "pose_time:=mid_frame")), ("right_to_left", ()),
    ],
)  # fmt: skip
def test_both_ends_of_the_shutter_explain_every_pixel(
    direction: str, more: tuple[str, ...], tmp_path: Path
) -> None:
    path, out = tmp_path / "flight", tmp_path / "out"
    words = ["--duration", "0.2", "--noise", "0.001", "--outliers", "0", "--readout-time", "0.02"]
    slow = ["--angular-velocity", "0.2", "0.5", "-0.3", "--linear-velocity", "0.3", "0.1", "0.1"]
    assert main(["simulate", str(path), *words, *slow, "--scan-direction", direction]) == 0
    words = ["--params", str(path / "parameters.yaml"), "--row", "first", "--row", "last", *more]
    exports = ["--gsplat", str(tmp_path / "splat"), "--ncore", str(tmp_path / "ncore")]
    assert main(["replay", str(path), "--out", str(out), *words, *exports]) == 0
    starts, ends, Ks = (
        np.load(tmp_path / "splat" / f"{name}.npy") for name in ("viewmats", "viewmats_rs", "Ks")
    )
    shutter = (tmp_path / "splat" / "shutter.txt").read_text().strip()
    names = (tmp_path / "splat" / "names.txt").read_text().split()
    assert shutter == f"ROLLING_{direction.upper()}"
    # Our own poses of these rows are the same.
    for views, name in ((starts, "first"), (ends, "last")):
        own = read_tum(out / f"poses_{name}.txt")
        assert len(own) == len(views)
        poses = np.linalg.inv(views)
        np.testing.assert_allclose(poses[:, :3, 3], own.positions, atol=1e-9)
        turns = Rotation.from_quat(own.quaternions).as_matrix()
        np.testing.assert_allclose(poses[:, :3, :3], turns, atol=1e-9)
    # NCore has the same poses the other way round, their times, and the same lens.
    told = json.loads((tmp_path / "ncore" / "ncore.json").read_text())
    lens = told["camera_model_parameters"]
    assert (lens["shutter_type"], lens["camera_model_type"]) == (shutter, "opencv-pinhole")
    camera = {
        "size": lens["resolution"], "focal": np.array(lens["focal_length"]),
        "centre": np.array(lens["principal_point"]),
    }  # fmt: skip
    np.testing.assert_array_equal(Ks[:, :2, 2], np.tile(camera["centre"], (len(Ks), 1)))
    assert [frame["file_path"] for frame in told["frames"]] == names
    for frame, start, end in zip(told["frames"], starts, ends, strict=True):
        np.testing.assert_allclose(frame["T_sensor_world"], np.linalg.inv([start, end]), atol=1e-12)
        first, last = frame["timestamps_us"]
        assert abs(first - int(Path(frame["file_path"]).stem) / 1000) <= 1
        assert last - first == 20_000
    # Both project the points to where they were seen.
    with open_bag(path) as bag:
        clouds = [read_correspondences(m) for _, _, m in bag.messages(["/correspondences"])]
    for cloud, start, end in zip(clouds, starts, ends, strict=True):
        some = slice(None, None, 10)
        found = [seen_between(start, end, camera, point, shutter) for point in cloud.points[some]]
        errors = np.linalg.norm(found - (cloud.pixels[some] + 0.5), axis=1)
        assert errors.max() < 0.01


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"distortion_model": "rational_polynomial"}, "has no lens rational_polynomial"),
        ({"scan_direction": "bottom_to_top", "readout_time": 0.01}, "this one moves bottom_to_top"),
    ],
)
def test_what_the_format_cannot_say_is_told(changes, text):
    with pytest.raises(NerfstudioError, match=text):
        transforms(Camera(640, 480, K, **changes), [])


def test_the_whole_lens_goes_to_ncore():
    """Twelve coefficients were once cut to eight; a fisheye whose corners are dark had no angle."""
    D = np.arange(1.0, 13.0) / 1000
    stamps = np.zeros((0, 2), int)
    told = sequence(
        Camera(640, 480, K, D, "rational_polynomial"), [], stamps, np.zeros((0, 2, 4, 4))
    )
    lens = told["camera_model_parameters"]
    # k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 of OpenCV.
    assert lens["radial_coeffs"] == (np.array([1, 2, 5, 6, 7, 8]) / 1000).tolist()
    assert lens["tangential_coeffs"] == [0.003, 0.004]
    assert lens["thin_prism_coeffs"] == (np.array([9, 10, 11, 12]) / 1000).tolist()
    tilted = Camera(640, 480, K, [*D, 0.1, 0.0], "rational_polynomial")
    with pytest.raises(ValueError, match="have no lens rational_polynomial of 14 coeff"):
        sequence(tilted, [], stamps, np.zeros((0, 2, 4, 4)))
    f = 240 / np.radians(100)  # 200 degrees from top to bottom
    wide = Camera(640, 480, [[f, 0, 319.5], [0, f, 239.5], [0, 0, 1]], np.zeros(4), "equidistant")
    told = sequence(wide, [], stamps, np.zeros((0, 2, 4, 4)))
    angle = told["camera_model_parameters"]["max_angle"]
    assert np.radians(100) <= angle <= np.pi


def test_a_part_of_the_sensor(tmp_path):
    from rs_localizer.core.camera import Roi

    camera = Camera(
        640, 480, K, [0.1, 0.01, 0.001, 0.002], readout_time=0.479,
        binning=(2, 2), roi=Roi(0, 100, 640, 200),
    )  # fmt: skip
    told = transforms(camera, [])
    assert (told["w"], told["h"], told["fl_x"]) == (320, 100, 250.0)
    # As Camera has it: a delivered pixel p is 2 p + offset on the sensor.
    assert (told["cx"], told["cy"]) == (319.5 / 2 + 0.5, 139.5 / 2 + 0.5)
    assert told["rolling_shutter_time"] == pytest.approx(0.2)  # 200 rows of 1 ms
    assert [told[k] for k in ("k1", "k2", "p1", "p2", "k3")] == [0.1, 0.01, 0.001, 0.002, 0.0]
