# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""IMU readings in CSV files."""

import numpy as np
import pytest

from rs_localizer.io.imu import ImuFileError, read_imu_csv

HEAD = "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_z\n"
LINE = "1403636579758555392,-0.1,0.14,0.07,8.12,-0.3,-3.7\n"


def test_a_file_of_euroc(tmp_path):
    """To the nanosecond, which a float would lose."""
    path = tmp_path / "data.csv"
    path.write_text(HEAD + LINE + "\n" + LINE.replace("392,", "393, "))
    stamps, rates, forces = read_imu_csv(path)
    assert stamps.tolist() == [1403636579758555392, 1403636579758555393]
    np.testing.assert_array_equal(rates, 2 * [[-0.1, 0.14, 0.07]])
    np.testing.assert_array_equal(forces, 2 * [[8.12, -0.3, -3.7]])


def test_a_file_from_a_spreadsheet(tmp_path):
    """Which marks UTF-8, ends lines twice, and puts spaces."""
    path = tmp_path / "data.csv"
    path.write_bytes(b"\xef\xbb\xbf" + (HEAD + LINE.replace(",", ", ")).encode())
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert read_imu_csv(path).stamps_ns.tolist() == [1403636579758555392]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD + LINE + "1,2,3\n", "line 3: must be time in ns.* got '1,2,3'"),
        (LINE.replace("0.07", "nan"), "line 1"),
        (LINE.replace("1403", "99991403"), "line 1"),
        ("stamp,wx,wy,wz,ax,ay,az\n" + LINE, "line 1.*headings begin with #"),
        (HEAD, "has no readings"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, said):
    path = tmp_path / "data.csv"
    path.write_text(text)
    with pytest.raises(ImuFileError, match=said) as caught:
        read_imu_csv(path)
    assert str(path) in str(caught.value)
