# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The IMU of ``map build``: which one is taken, what is read of it, what is said."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.cli import UsageError
from rs_localizer.cli.main import main
from rs_localizer.cli.map.build import add_imu_arguments, imu_of
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.imu import ImuFileError
from rs_localizer.offline.image_sources import SourceError


def given(images: Path, *words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_imu_arguments(parser.add_argument_group("IMU"))
    known = argparse.Namespace(images=images, image=None, camera_info=None)
    return parser.parse_args(list(words), known)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """With an IMU at rest beside the camera."""
    out = tmp_path_factory.mktemp("recorded") / "bag"
    words = ["--duration", "0.3", "--points", "20", "--imu", "--accelerometer-bias", "0"]
    assert main(["simulate", str(out), *words, "--accelerometer-noise", "0"]) == 0
    return out


def test_that_of_a_bag_is_found(recorded):
    """Forces, and where TF says that it is."""
    imu = imu_of(given(recorded))
    assert imu is not None
    assert not imu.asked
    forces = imu.recording.specific_forces
    assert forces is not None
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 9.80665, rtol=0.05)
    assert imu.recording.camera_from_imu is not None
    np.testing.assert_allclose(imu.recording.imu_in_camera, [0.03, -0.02, -0.01], atol=1e-9)


def test_of_several_none_is_taken(recorded, tmp_path, capsys):
    with open_bag(recorded) as bag, BagWriter(tmp_path / "two") as out:
        for _, stamp_ns, message in bag.messages(["/imu"]):
            out.write("/left", message, stamp_ns)
            out.write("/right", message, stamp_ns)
    assert imu_of(given(tmp_path / "two")) is None
    assert "choose /left or /right with --imu" in capsys.readouterr().out
    with pytest.raises(SourceError, match="choose one with --imu"):
        imu_of(given(tmp_path / "two", "--imu"))
    assert imu_of(given(tmp_path / "two", "--imu", "/left")) is not None


def test_a_video_may_have_a_file_beside_it(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text("#timestamp [ns],...\n1000,1,2,3,4,5,6\n2000,1,2,3,4,5,7\n")
    video = tmp_path / "walk.mp4"
    imu = imu_of(given(video, "--imu", str(path)))
    assert imu is not None
    assert imu.asked
    assert imu.recording.camera_from_imu is None
    np.testing.assert_array_equal(imu.recording.specific_forces, [[4, 5, 6], [4, 5, 7]])
    assert imu_of(given(video)) is None
    with pytest.raises(UsageError, match=r"give --imu FILE\.csv"):
        imu_of(given(video, "--imu"))
    with pytest.raises(ImuFileError, match="cannot be read"):
        imu_of(given(video, "--imu", "/imu"))
