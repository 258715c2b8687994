# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay`` of images: the same as detect, then replay of what it wrote."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import write_mp4

from rs_localizer.cli.commands import main
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_files import write_calibration
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.images import decode_image

READOUT = 0.02


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of images, and beside it the same as a video with its calibration."""
    path = tmp_path_factory.mktemp("images") / "walls"
    words = ["--images", "--duration", "0.4", "--readout-time", str(READOUT)]
    assert main(["simulate", str(path), *words, "--trajectory", "tum_vi_room5"]) == 0
    with open_bag(path) as bag:
        (topic,) = (t for t, kind in bag.topics.items() if kind.endswith("Image"))
        images = [decode_image(bytes(m.data), m.format) for _, _, m in bag.messages([topic])]
        (info,) = (t for t, kind in bag.topics.items() if kind.endswith("CameraInfo"))
        camera = read_camera_info(next(m for _, _, m in bag.messages([info]))).camera(
            0.0, "top_to_bottom"
        )
    write_mp4(path.parent / "walls.mp4", images, 30.0)
    write_calibration(path.parent / "camera.yaml", camera)
    return path


@pytest.mark.parametrize("kind", ["bag", "video"])
def test_poses_are_those_of_detect_and_replay(kind: str, walls: Path, tmp_path: Path) -> None:
    folder = walls.parent
    source = [str(walls)]
    if kind == "video":
        source = [str(folder / "walls.mp4"), "--calibration", str(folder / "camera.yaml")]
    given = [*source, "--map", str(walls / "marker_map.yaml"), "-p", f"readout_time:={READOUT}"]
    more = ["-p", "inlier_threshold:=2.5", "--smooth"]
    seen, steps, once = tmp_path / "seen", tmp_path / "steps", tmp_path / "once"
    assert main(["detect", *given, "--images", "--out", str(seen)]) == 0
    shutter = ["--params", str(seen / "parameters.yaml"), *more]
    assert main(["replay", str(seen), *shutter, "--out", str(steps)]) == 0
    assert main(["replay", *given, *more, "--out", str(once)]) == 0
    for name in ("poses.txt", "twists.txt"):
        rows = [np.loadtxt(place / name) for place in (steps, once)]
        assert len(rows[0]) > 5
        np.testing.assert_array_equal(*rows)


def test_what_is_missing_is_said(walls: Path, tmp_path: Path, capsys: Any) -> None:
    words = ["replay", str(walls.parent / "walls.mp4"), "--out", str(tmp_path / "out"), "--map"]
    assert main([*words, str(walls / "marker_map.yaml")]) == 2
    assert "a video or folder has no camera_info: give --camera" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["replay", str(walls.parent / "walls.mp4")]) == 1
    assert "walls.mp4 is a video, not matches: give --map, of markers" in capsys.readouterr().err
