# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of phones and boards, by one command: on rendered miniatures in their layouts."""

import cv2
import miniatures
import numpy as np
import pytest
from miniatures import PERIOD, SINCE_BOOT, SQUARE

from benchmarks.__main__ import main
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.real import tracks
from benchmarks.real.footage import read_footage

READOUT = 0.02
LENGTH = 24
STRAIGHT = TrueCamera(320, 240, 260.0, distortion=(0.0,) * 5, readout_time=READOUT)
BENT = TrueCamera(320, 240, 260.0, readout_time=READOUT)


@pytest.fixture(scope="module")
def corner():
    """A phone's film of the corner of a room."""
    motion = miniatures.in_hand((1.0, 0.3, 1.0), 3, 2.0)
    return miniatures.film(LENGTH, STRAIGHT, miniatures.papered(), motion)


@pytest.fixture(scope="module")
def board():
    """A film of a printed board."""
    motion = miniatures.in_hand((0.0, 0.0, 1.0), 5, 1.5)
    return miniatures.film(LENGTH, BENT, miniatures.with_board(9, 6), motion)


@pytest.fixture(scope="module")
def stray(corner, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stray") / "71de12f9"
    miniatures.write_stray(folder, corner)
    return folder


def test_of_stray_scanner_the_second_stamp_is_that_of_the_first_image(stray, corner):
    footage = read_footage(stray)
    images = list(footage.images())
    assert len(images) == LENGTH
    stamps = np.array([stamp for stamp, _ in images])
    np.testing.assert_allclose(1e-9 * stamps - SINCE_BOOT, corner.seconds, atol=2e-6)
    assert np.abs(images[5][1].astype(float) - corner.images[5]).mean() < 6.0  # compressed
    np.testing.assert_allclose(footage.camera.K, STRAIGHT.matrix, atol=1e-5)
    turns, places = corner.poses(corner.seconds + 0.5 * READOUT)
    np.testing.assert_allclose(footage.depths.rotations, turns.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(footage.depths.positions, places, atol=1e-6)


def test_depths_are_those_of_the_image_and_unsure_ones_are_left_out(stray, corner):
    depths = read_footage(stray).depths
    pixels = np.random.default_rng(0).uniform([60.0, 20.0], [300.0, 220.0], (200, 2))
    true = corner.depths[7][tuple(np.rint(pixels[:, ::-1]).astype(int).T)]
    found = depths.at(7, pixels, (320, 240))
    assert np.median(np.abs(found - true)) < 0.01
    assert np.isnan(depths.at(7, np.array([[5.0, 100.0]]), (320, 240))).all()


def test_corners_are_followed_to_where_their_row_sees_them(stray, corner):
    """A point that the first image shows, projected by the true motion at the row of its pixel."""
    followed = tracks.tracked(read_footage(stray), 4)
    first, last = (followed.images == k for k in (0, 3))
    _, a, b = np.intersect1d(followed.points[first], followed.points[last], return_indices=True)
    start, end = followed.pixels[first][a], followed.pixels[last][b]
    assert len(start) > 60
    turns, places = corner.poses(STRAIGHT.exposed(start))
    deep = cv2.remap(
        corner.depths[0], start[:, :1].astype(np.float32), start[:, 1:].astype(np.float32), 1
    )
    local = deep * np.column_stack([STRAIGHT.bearings(start), np.ones(len(start))])
    points = turns.apply(local) + places
    turns, places = corner.poses(corner.seconds[3] + STRAIGHT.exposed(end))
    errors = STRAIGHT.project(turns.inv().apply(points - places)) - end
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.5


def rows(printed: str) -> dict[str, list[str]]:
    return {line[:18].strip(): line[18:].split() for line in printed.splitlines()}


def test_a_folder_of_stray_scanner_becomes_a_row_and_a_picture(
    stray, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(tracks, "_CORNERS", 100)
    words = ["-p", f"readout_time:={READOUT}", "--out", str(tmp_path)]
    assert main(["real", "gyro", str(stray), *words]) == 0
    printed, said = capsys.readouterr()
    assert "turned by" in said
    assert "another one" not in said
    later, solvepnp = rows(printed)["tracked, 1 later"], rows(printed)["solvepnp"]
    assert later[0] == f"{LENGTH}/{LENGTH}"
    assert float(later[1].strip(",")) < 0.7 * float(solvepnp[1].strip(","))  # turns
    assert float(later[5].strip(",")) < 4.0  # deg/s, of up to 65
    assert (tmp_path / "gyro.png").stat().st_size > 10_000


@pytest.mark.parametrize("late", [0, 1])
def test_an_oak_camera_before_a_board_and_the_stamps_of_other_images(board, late, tmp_path, capsys):
    miniatures.write_oak(tmp_path / "oak", board, late)
    lens = miniatures.write_lens(tmp_path / "lens.yaml", BENT)
    words = ["--board", "9x6", "--square", f"{SQUARE}", "--camera", str(lens),
             "-p", f"readout_time:={READOUT}", "--out", str(tmp_path)]  # fmt: skip
    assert main(["real", "gyro", str(tmp_path / "oak"), *words]) == 0
    printed, said = capsys.readouterr()
    assert ("(+1 images: each has the stamp of another one)" in said) == bool(late)
    found = float(said.split("gyroscope: ")[1].split(" ms")[0])
    assert found == pytest.approx(1e3 * PERIOD * late, abs=1.0)
    assert float(said.split("bias ")[1].split()[0]) == pytest.approx(
        np.degrees(np.linalg.norm(miniatures.BIAS)), abs=0.5
    )
    later = rows(printed)["tracked, 1 later"]
    assert later[0] == f"{LENGTH}/{LENGTH}"
    assert float(later[5].strip(",")) < 2.5  # deg/s, of up to 86
    assert "like the gyroscope at +0.0 ms" in printed or "like the gyroscope at -0.0" in printed


@pytest.mark.bench
@pytest.mark.timeout(1800)
def test_an_oak_camera_before_anything(tmp_path, capsys):
    """Without a board and a lens: COLMAP's structure, three minutes of CPU."""
    motion = miniatures.in_hand((1.0, 0.3, 1.0), 3, 2.0)
    film = miniatures.film(40, STRAIGHT, miniatures.papered(), motion)
    miniatures.write_oak(tmp_path / "oak", film)
    words = ["-p", f"readout_time:={READOUT}", "--out", str(tmp_path)]
    assert main(["real", "gyro", str(tmp_path / "oak"), *words]) == 0
    later = rows(capsys.readouterr().out)["tracked, 1 later"]
    assert float(later[5].strip(",")) < 2.0  # deg/s


def test_what_cannot_be_used_is_said_in_one_line(stray, tmp_path, capsys):
    def refused(*words: str) -> str:
        assert main(["real", "gyro", *words, "--out", str(tmp_path / "out")]) == 1
        return capsys.readouterr().err

    assert "must be a video, a folder with rgb.mp4" in refused(str(tmp_path))
    (tmp_path / "frames.csv").write_text("timestamp_ns,path\n1,a.png\n")
    assert "lacks the columns exposure_us" in refused(str(tmp_path))
