# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A small rendered room, mapped from a few images and used."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.room_mapping import Errors, Piece, Room, localized, without_refinement
from rs_localizer import data
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools.mapping.build import Built
from rs_localizer.tools.mapping.gauge import through
from rs_localizer.tools.mapping.seen_images import SeenImage
from rs_localizer.tools.simulation.simulated_settings import ImageSettings

pytest.importorskip("pycolmap")

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K, readout_time=0.03)
WALK = Piece(37.4, 2.2, 12.0)
# Between the images of the walk, and faster ones.
OTHERS = Piece(37.55, 1.9, 5.0)


@pytest.fixture(scope="module")
def room() -> Room:
    trajectory = read_tum(data.path(data.HAND_MOTION))
    return Room(trajectory, CAMERA, ImageSettings(noise=2.0), keypoints=300)


@pytest.fixture(scope="module")
def views(room, tmp_path_factory) -> list[SeenImage]:
    return room.look(WALK, tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("colmap")


@pytest.fixture(scope="module")
def built(room, views, folder) -> Built:
    @contextmanager
    def stage(_: str, total: int) -> Iterator[Callable[[int], object]]:
        done: list[int] = []
        yield done.append
        assert sum(done) <= total

    return room.build(views, folder, stage)


def test_the_map_is_where_the_room_is(room, built):
    """In metres, in the markers' frame: landmarks lie on the walls."""
    distances = np.min(
        [np.abs((built.landmarks.points - p.corner) @ p.normal) for p in room.planes], axis=0
    )
    assert len(built.landmarks) > 100
    assert np.median(distances) < 0.02
    assert np.all(np.linalg.eigvalsh(built.landmarks.covariances) > 0.0)
    assert built.refined.after < 0.6 * built.refined.before


def test_what_landmarks_share_is_told(room, built):
    """How far the landmarks of a wall lie behind it on average, in deviations: 13 without.

    Two seconds of a walk do not tell how much errors of a second have in common.
    """
    landmarks = built.landmarks
    off = np.array([(landmarks.points - p.corner) @ p.normal for p in room.planes])
    wall = np.abs(off).argmin(axis=0)
    off, normals = off[wall, np.arange(len(wall))], np.array([p.normal for p in room.planes])[wall]
    weights = 1.0 / np.einsum("ni,nij,nj->n", normals, landmarks.covariances, normals)
    modes = np.einsum("ni,nik->nk", normals, landmarks.error_modes)
    told, untold = [], []
    for k in range(len(room.planes)):
        here = (wall == k) & (np.abs(off) < 0.1)
        if np.count_nonzero(here) > 20:
            w = weights[here]
            mean, shared = w @ off[here] / w.sum(), w @ modes[here] / w.sum()
            told.append(mean**2 / (shared @ shared + 1.0 / w.sum()))
            untold.append(mean**2 * w.sum())
    assert len(told) > 2
    assert np.mean(untold) > 100.0
    assert np.mean(told) < 10.0


def truth(room: Room, views: list[SeenImage], built: Built) -> tuple[Array, Array, Rotation]:
    """Where the camera was in the map and in the room (g,3), at the middle rows, and how the map
    is turned into the room on average.
    """
    times, positions, quaternions = built.middle_rows([view.stamp_ns for view in views])
    states = [room.motion.state(int(time), np.zeros(1)) for time in times]
    rotations = Rotation.from_matrix(np.concatenate([state.rotations for state in states]))
    turn = (rotations * Rotation.from_quat(quaternions).inv()).mean()
    return positions, np.concatenate([state.positions for state in states]), turn


def test_the_way_of_the_camera_has_the_right_shape_and_size(room, views, built):
    positions, true, turn = truth(room, views, built)
    assert len(positions) > 0.9 * len(views)
    to_room = through(positions, true)
    assert to_room.scale == pytest.approx(1.0, abs=0.02)
    assert np.median(np.linalg.norm(to_room(positions) - true, axis=1)) < 0.01
    assert np.degrees(turn.magnitude()) < 2.0


def test_other_images_are_localized(room, views, built):
    """Without markers; better than with a global shutter all the way.

    The two markers that are seen hang on one wall: the map is laid onto the room by its camera.
    """
    positions, true, turn = truth(room, views, built)
    clouds = room.clouds(OTHERS)

    def errors(landmarks: Map, solver: str) -> Errors:
        points = turn.apply(landmarks.points - positions.mean(axis=0)) + true.mean(axis=0)
        laid = Map(points, None, landmarks.descriptors, "map")
        return localized(room, clouds, laid, solver)

    ours = errors(built.landmarks, "r6p_vcwt")
    theirs = errors(without_refinement(built), "p3p")
    assert ours.share > 0.9
    assert np.median(ours.positions) < 0.015
    assert np.median(ours.angles) < 0.25
    assert np.median(theirs.positions) > 2.0 * np.median(ours.positions)
