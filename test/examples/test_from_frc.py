# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files as PhotonVision and WPILib write them become a camera and a map."""

import numpy as np
from typed_commands import EXAMPLES, commands, started

import rs_localizer as rsl
from rs_localizer.markers.map_files import read_marker_map

FILES = {
    "config.json": """{"resolution": {"width": 640.0, "height": 480.0}, "cameraIntrinsics":
        {"rows": 3, "cols": 3, "type": 6, "data": [500.0, 0, 320.5, 0, 510.0, 240.5, 0, 0, 1]},
        "distCoeffs": {"rows": 1, "cols": 8, "data": [1, 2, 3, 4, 0, 0, 0, 0]},
        "calobjectSize": {"width": 7.0, "height": 7.0}, "lensmodel": "LENSMODEL_OPENCV"}""",
    "field.json": """{"tags": [{"ID": 7, "pose": {"translation": {"x": 1.0, "y": 0.0, "z": 2.0},
        "rotation": {"quaternion": {"W": 0.0, "X": 0.0, "Y": 0.0, "Z": 1.0}}}}],
        "field": {"length": 16.0, "width": 8.0}}""",
}


def test_both_files_are_read_as_their_programs_mean_them(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "examples").symlink_to(EXAMPLES)
    said = [started(line, tmp_path) for line in commands("from_frc.py")]
    assert [done.stdout for done in said] == ["camera.json: a camera\n", "field.yaml: 1 tags\n"]
    lens = rsl.read_calibration(str(tmp_path / "camera.json"))
    np.testing.assert_array_equal(lens.D[:5], [1, 2, 3, 4, 0])
    assert not lens.D[5:].any()
    np.testing.assert_array_equal(lens.K[0], [500.0, 0.0, 320.5])
    # The tag looks back along x; up is z, and to the right of who looks at it is -y.
    (marker,) = read_marker_map(str(tmp_path / "field.yaml")).markers
    expected = [[1.0, 0.08255, 2.08255], [1.0, -0.08255, 2.08255]]
    np.testing.assert_allclose(marker.corners[:2], expected, rtol=0.0, atol=1e-9)
