# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of image files that are times, and sentences on sources without images."""

from pathlib import Path

import pytest

from rs_localizer.cli.commands import main
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.offline.image_sources import image_files, name_times

EVERY_33_MS = [0, 33_366_000, 66_733_000]


@pytest.mark.parametrize(
    ("first_ns", "unit"),
    [
        (1_403_636_579_763_000_000, 1),  # EuRoC's
        (1_403_636_579_763_000_000, 10**3),  # us since 1970: 16 digits
        (1_403_636_579_763_000_000, 10**6),
        (1_403_636_579_763_000, 1),  # ns since a phone was started: 16 digits, too
        (86_412_345_678_901, 1),
    ],
)
def test_their_unit_is_that_of_the_interval(first_ns, unit):
    files = [Path(f"{(first_ns + later) // unit}.png") for later in EVERY_33_MS]
    found = name_times(files)
    assert found is not None
    assert list(found) == files
    for file, later in zip(files, EVERY_33_MS, strict=True):
        assert abs(found[file] - first_ns - later) < unit


@pytest.mark.parametrize("names", [("0001", "0002", "0003"), ("10", "15", "20"), ("a", "b")])
def test_numbers_of_frames_are_none(names):
    assert name_times([Path(f"{name}.png") for name in names]) is None


def test_what_has_no_images_is_named(tmp_path, capsys):
    path = tmp_path / "bag"
    with BagWriter(path) as bag:
        bag.write("/eye/theora", make_message("std_msgs/msg/String", data=""), 10**9)
    assert main(["detect", str(path), "--board", "9x6", "--square", "0.03", "--out", "x"]) == 1
    assert "it has /eye/theora (std_msgs/msg/String)" in capsys.readouterr().err
    (tmp_path / "IMG_0001.heic").touch()
    with pytest.raises(ValueError, match=r"no file ends in \.jpg, .*convert others to PNG"):
        image_files(tmp_path)
