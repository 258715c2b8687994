# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A hand-held gripper with a camera: videos of a room and of demonstrations -> trajectories."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import write_mp4

from rs_localizer import data
from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.recording import MAP, MAP_FRAME
from rs_localizer.io.trajectories import read_tum
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.families import family
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.mapping.gauge import through
from rs_localizer.tools.simulation.renderer import ImageSettings, Renderer
from rs_localizer.tools.simulation.simulated_frames import frame_stamps
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import Scene, printed, room

pytest.importorskip("pycolmap")
pytest.importorskip("pyarrow", reason="needs pyarrow", exc_type=ImportError)

READOUT, RATE = 0.03, 12.0
SHUTTER = ["-p", f"readout_time:={READOUT}"]
K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K, readout_time=READOUT)
WALK, DEMOS = (37.4, 2.2), ((37.56, 0.5), (38.3, 0.5))  # start and duration, s
MOTION = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))


def marked_room() -> Scene:
    """A room with two markers on each wall, whose pictures those who stand inside may read."""
    path = sampled_states(MOTION)
    drawn, middle, scene, markers = family("4x4_250"), path.positions.mean(axis=0), room(path), []
    for plane in scene.planes:
        sheet = 14 * (drawn.cells + 2)
        mirrored = (middle - plane.corner) @ plane.normal > 0.0
        upright = abs(plane.down[2]) > 0.5
        for share in (0.3, 0.7) if abs(plane.normal[2]) < 0.5 else ():
            white = np.pad(pattern(drawn, len(markers)), 1, constant_values=True)
            sides = np.array(plane.texture.shape[::-1])
            left, top = np.rint(sides * ((share, 0.5) if upright else (0.5, share)) - 0.5 * sheet)
            left, top = int(left), int(top)
            paper = printed(white, (235, 26), 14)[:, :: -1 if mirrored else 1]
            plane.texture[top : top + sheet, left : left + sheet] = paper
            centre = plane.points(np.array([[left + 0.5 * sheet, top + 0.5 * sheet]]))[0]
            right, up = (-plane.right if mirrored else plane.right), -plane.down
            pose = Pose(centre, np.column_stack([right, up, np.cross(right, up)]))
            side = 14 * drawn.cells * plane.texel
            markers.append(Marker.at("4x4_250", len(markers), side, pose))
    return replace(scene, marker_map=MarkerMap(tuple(markers)))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> SimpleNamespace:
    """Videos along a recorded motion in a rendered room with markers; a map of the first one."""
    folder = tmp_path_factory.mktemp("gripper")
    scene = marked_room()
    renderer = Renderer(CAMERA, scene.planes, ImageSettings(noise=1.0))

    def film(start: float, duration: float, path: Path) -> np.ndarray:
        """A video; the stamps of its images, ns."""
        first = MOTION.intervals_ns[0][0] + round(1e9 * start)
        every = frame_stamps(MOTION, CAMERA, RATE)
        stamps = [ns for ns in every if first <= ns < first + round(1e9 * duration)]
        path.parent.mkdir()
        write_mp4(path, (renderer.image(MOTION, ns, (0, ns)) for ns in stamps), RATE)
        return np.array(stamps)

    film(*WALK, folder / "room" / "room.mp4")
    demos = [folder / f"demo_{k}" / f"demo_{k}.mp4" for k in range(len(DEMOS))]
    stamps = [film(*piece, path) for piece, path in zip(DEMOS, demos, strict=True)]
    lens = {"K": K.tolist(), "D": [0, 0, 0, 0], "width": 320, "height": 240}
    (folder / "camera.json").write_text(json.dumps(lens))
    write_marker_map(folder / "wall.yaml", scene.marker_map)
    words = ["map", "build", str(folder / "room" / "room.mp4"), "--out", str(folder / "map")]
    words += ["--calibration", str(folder / "camera.json"), "--markers", str(folder / "wall.yaml")]
    assert main([*words, *SHUTTER]) == 0
    made = folder / "map"
    return SimpleNamespace(folder=folder, planes=scene.planes, demos=demos, stamps=stamps, map=made)


def test_the_map_is_where_the_room_is_and_tells_what_its_landmarks_share(filmed):
    """How far the landmarks of a wall lie behind it on average, in deviations: 13 without.

    Two seconds of a walk do not tell how much errors of a second have in common.
    """
    landmarks, planes = read_map_file(filmed.map / MAP, MAP_FRAME), filmed.planes
    off = np.array([(landmarks.points - p.corner) @ p.normal for p in planes])
    wall = np.abs(off).argmin(axis=0)
    off, normals = off[wall, np.arange(len(wall))], np.array([p.normal for p in planes])[wall]
    assert len(landmarks) > 100
    assert np.median(np.abs(off)) < 0.02
    weights = 1.0 / np.einsum("ni,nij,nj->n", normals, landmarks.covariances, normals)
    assert np.all(weights > 0.0)
    modes = np.einsum("ni,nik->nk", normals, landmarks.error_modes)
    told, untold = [], []
    for k in range(len(planes)):
        here = (wall == k) & (np.abs(off) < 0.1)
        if np.count_nonzero(here) > 20:
            w = weights[here]
            mean, shared = w @ off[here] / w.sum(), w @ modes[here] / w.sum()
            told.append(mean**2 / (shared @ shared + 1.0 / w.sum()))
            untold.append(mean**2 * w.sum())
    assert len(told) > 1
    assert np.mean(untold) > 100.0
    assert np.mean(told) < 15.0


def test_demonstrations_become_trajectories(filmed, tmp_path):
    lens = ["--calibration", str(filmed.folder / "camera.json"), *SHUTTER]
    words = ["replay", *map(str, filmed.demos), "--map", str(filmed.map), *lens, "--smooth"]
    table = tmp_path / "demos.parquet"
    tables = ["--parquet", str(table), "--workers", "1"]
    assert main([*words, "--out", str(tmp_path / "poses"), *tables]) == 0
    from pyarrow.parquet import read_table  # an extra

    rows = read_table(table).to_pylist()
    both = []
    for k, path in enumerate(filmed.demos):
        mine = [row for row in rows if row["recording"] == str(path)]
        good = [row for row in mine if row["state"] == "localized"]
        assert len(mine) == len(filmed.stamps[k])
        assert len(good) >= 0.9 * len(mine)
        # Since the first image, whose stamp is 1 s.
        times = [int(filmed.stamps[k][0] + row["pose_stamp_ns"] - 10**9) for row in good]
        true = [MOTION.state(time, np.zeros(1)).positions[0] for time in times]
        found = np.array([[row[name] for name in "xyz"] for row in good])
        both.append((found, np.array(true)))
        for name in ("pose_covariance", "twist_covariance"):
            covariances = np.array([row[name] for row in good]).reshape(-1, 6, 6)
            assert (np.linalg.eigvalsh(covariances) > 0.0).all()
    found, true = (np.concatenate(side) for side in zip(*both, strict=True))
    # The two markers in the video hang on one wall and hold the place of the map to centimetres,
    # which all demonstrations share: 19 and 1.4 mm when this was written.
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.05
    assert np.median(np.linalg.norm(through(found, true)(found) - true, axis=1)) < 0.005
