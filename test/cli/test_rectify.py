# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer rectify``: which images, which are left out, what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from rs_localizer.cli.main import main

READOUT = 0.02


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    path = tmp_path_factory.mktemp("rectify") / "walls"
    words = ["--images", "--duration", "0.15", "--width", "320", "--height", "240"]
    more = ["--focal", "250", "--format", "png", "--readout-time", str(READOUT)]
    assert main(["simulate", str(path), *words, *more]) == 0
    return path


@pytest.fixture
def poses(walls: Path, tmp_path: Path) -> Path:
    """Of all images but one."""
    out = tmp_path / "poses"
    words = ["--map", str(walls / "marker_map.yaml"), "--row", "first", "--row", "last"]
    assert main(["replay", str(walls), *words, "--out", str(out)]) == 0
    for file in (out / "poses_first.txt", out / "poses_last.txt"):
        file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))
    return out


def test_images_with_a_pose(walls, poses, tmp_path, capsys):
    out = tmp_path / "global"
    words = ["--readout-time", str(READOUT), "--out", str(out), "--poses", str(poses)]
    by_map = ["--depth", "map", "--map", str(walls / "marker_map.yaml")]
    for depth in ((), by_map):
        assert main(["rectify", str(walls), *words, *depth, "--overwrite"]) == 0
        said = capsys.readouterr().out
        names = (out / "images.txt").read_text().split()
        assert sorted(path.name for path in out.glob("*.png")) == sorted(names)
        assert f"{len(names)} of {len(names) + 1} images; the others have no pose" in said
        image = cv2.imread(str(out / names[0]), cv2.IMREAD_UNCHANGED)
        assert image.shape[:2] == (240, 320)
        assert 0.7 < (image > 0).mean() < 1.0


def test_wrong_usage(walls, poses, tmp_path, capsys):
    words = ["rectify", str(walls), "--poses", str(poses), "--out", str(tmp_path / "out")]
    shutter = ["--readout-time", str(READOUT)]
    marker_map = ["--map", str(walls / "marker_map.yaml")]
    assert main([*words, *shutter, "--depth", "plane"]) == 2
    assert main([*words, *shutter, *marker_map]) == 2
    assert main([*words, "--readout-time", "0"]) == 2
    assert "give the readout time" in capsys.readouterr().err
    assert main([*words, *shutter, "--depth", "plane", *marker_map]) == 1
    assert "points of the map lie in no plane" in capsys.readouterr().err
    (poses / "poses_last.txt").unlink()
    assert main([*words, *shutter]) == 1
    assert "has no poses_last.txt: replay with --row first --row last" in capsys.readouterr().err
