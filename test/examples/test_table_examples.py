# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the examples make of a table says where the camera saw the points, by other projections."""

import importlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

pytest.importorskip("pyarrow", exc_type=ImportError)

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.tools.simulation.renderer import Renderer
from rs_localizer.tools.simulation.simulated_frames import middle_stamp
from rs_localizer.tools.simulation.true_motion import ConstantVelocity
from rs_localizer.tools.simulation.walls import TexturedPlane, collage

SLOW = ["--angular-velocity", "0.2", "0.5", "-0.3", "--linear-velocity", "0.3", "0.1", "0.1"]
SHOTS = ["--duration", "0.2", "--noise", "0.001", "--outliers", "0", "--readout-time", "0.02"]


def example(name: str) -> Any:
    return importlib.import_module(name)


def flown(folder: Path, direction: str, more: tuple[str, ...] = ()) -> SimpleNamespace:
    """A flight, its table, and what was seen in each of its images."""
    path, table = folder / "flight", folder / "frames.parquet"
    assert main(["simulate", str(path), *SHOTS, *SLOW, "--scan-direction", direction]) == 0
    words = ["--params", str(path / "parameters.yaml"), "--parquet", str(table), *more]
    assert main(["replay", str(path), "--out", str(folder / "out"), *words]) == 0
    with open_bag(path) as bag:
        clouds = [read_correspondences(m) for _, _, m in bag.messages(["/correspondences"])]
    return SimpleNamespace(table=str(table), clouds={cloud.stamp_ns: cloud for cloud in clouds})


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
    flight = flown(tmp_path, direction, more)
    splat, ncore = tmp_path / "splat", tmp_path / "ncore"
    example("to_gsplat").main(flight.table, str(splat))
    example("to_ncore").main(flight.table, str(ncore))
    starts, ends, Ks = (np.load(splat / f"{n}.npy") for n in ("viewmats", "viewmats_rs", "Ks"))
    shutter, names = (splat / "shutter.txt").read_text().strip(), (splat / "names.txt").read_text()
    assert shutter == f"ROLLING_{direction.upper()}"
    # NCore has the same poses the other way round, their times, and the same lens.
    told = json.loads((ncore / "ncore.json").read_text())
    lens = told["camera_model_parameters"]
    assert (lens["shutter_type"], lens["camera_model_type"]) == (shutter, "opencv-pinhole")
    camera = {
        "size": lens["resolution"], "focal": np.array(lens["focal_length"]),
        "centre": np.array(lens["principal_point"]),
    }  # fmt: skip
    np.testing.assert_array_equal(Ks[:, :2, 2], np.tile(camera["centre"], (len(Ks), 1)))
    assert [frame["file_path"] for frame in told["frames"]] == names.split()
    for frame, start, end in zip(told["frames"], starts, ends, strict=True):
        np.testing.assert_allclose(frame["T_sensor_world"], np.linalg.inv([start, end]), atol=1e-12)
        first, last = frame["timestamps_us"]
        assert abs(first - int(Path(frame["file_path"]).stem) / 1000) <= 1
        assert last - first == 20_000
    # Both project the points to where they were seen.
    assert len(flight.clouds) == len(starts)
    for cloud, start, end in zip(flight.clouds.values(), starts, ends, strict=True):
        some = slice(None, None, 10)
        found = [seen_between(start, end, camera, point, shutter) for point in cloud.points[some]]
        errors = np.linalg.norm(found - (cloud.pixels[some] + 0.5), axis=1)
        assert errors.max() < 0.01


def test_transforms_and_a_view(tmp_path: Path) -> None:
    flight = flown(tmp_path, "top_to_bottom")
    nerfstudio = example("to_nerfstudio")
    nerfstudio.main(flight.table, str(tmp_path / "scene"))
    told = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert (told["camera_model"], told["w"], told["h"]) == ("OPENCV", 640, 480)
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
        assert np.median(np.hypot(seen[0] - u, seen[1] - v)) < 0.01
    camera, _ = example("read_table").read_table(flight.table)
    for change, text in (
        ({"distortion_model": "rational_polynomial"}, "has no lens rational_polynomial"),
        ({"scan_direction": "bottom_to_top"}, "from top to bottom, not bottom_to_top"),
    ):
        with pytest.raises(ValueError, match=text):
            nerfstudio.transforms(camera | change, [], [])
    pytest.importorskip("rerun")
    example("to_rerun").main(flight.table, str(tmp_path / "seen.rrd"))
    assert (tmp_path / "seen.rrd").read_bytes().startswith(b"RRF")


def test_images_as_of_a_global_shutter():
    """A rendered wall at 1.5 m: 9.3 grey levels before, 3.6 by the turn, 0.6 with its distance."""
    made = example("to_global_shutter")
    K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
    camera = Camera(320, 240, K, [0.05, -0.02, 0.001, 0.0], readout_time=0.03)
    motion = ConstantVelocity(np.array([0.8, 1.5, -1.0]), np.array([0.8, 0.3, 0.3]), 0.3)
    stamp = motion.start_ns + 100_000_000
    middle = middle_stamp(camera, stamp)
    states = motion.state(middle, np.array([-0.5, 0.0, 0.5]) * 0.03)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = states.rotations, states.positions
    right, down, _ = poses[1, :3, :3].T
    corner = poses[1, :3, 3] + poses[1, :3, :3] @ [-2.0, -1.5, 1.5]
    picture = collage(400, 300, np.random.default_rng(0))
    wall = (TexturedPlane(corner, right, down, 0.01, picture),)
    rolling = Renderer(camera, wall).image(motion, stamp)
    still = Renderer(Camera(320, 240, K, camera.D), wall).image(motion, middle)
    shot = SimpleNamespace(first=poses[0], middle=poses[1], last=poses[2])
    errors = [float(np.mean(np.abs(rolling.astype(float) - still)))]
    for depth in (np.inf, 1.5):
        image = made.rectified(camera, rolling, shot, depth)
        known = image > 0
        assert 0.75 < known.mean() < 1.0
        errors.append(float(np.mean(np.abs(image.astype(float) - still)[known])))
    assert errors[2] < 0.35 * errors[1], errors
    assert errors[1] < 0.8 * errors[0], errors
