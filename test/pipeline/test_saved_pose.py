# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The last pose in a file."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.io.transforms import Transform
from rs_localizer.pipeline.given_pose import load_pose, save_pose

POSE = Transform(Rotation.from_euler("zyx", [0.7, 0.1, -0.2]).as_matrix(), np.array([3.0, 4, 0.2]))


def test_what_is_saved_is_started_from_and_less_certain(tmp_path):
    file = tmp_path / "pose.json"
    assert load_pose(file) is None
    save_pose(file, "map", POSE, 1e-4 * np.eye(6))
    given = load_pose(file)
    assert (given.stamp_ns, given.frame, given.body) == (0, "map", "")
    assert np.array_equal(given.pose.translation, POSE.translation)
    assert np.array_equal(given.pose.rotation, POSE.rotation)
    assert np.sqrt(given.covariance.diagonal()) == pytest.approx(np.repeat([0.5, 0.26], 3), 1e-3)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"position": [1.0, 2.0]}, "shapes"),
        ({"position": [1.0, 2.0, float("nan")]}, "shapes"),
        ({"rotation": np.ones((3, 3)).tolist()}, "no rotation"),
        ({"rotation": np.diag([1.0, 1.0, -1.0]).tolist()}, "no rotation"),  # a mirror
        ({"covariance": (-np.eye(6)).tolist()}, "no covariance"),
        ({"position": "here"}, "holds no pose"),
        (None, "holds no pose"),
    ],
)
def test_a_file_that_holds_no_pose_is_named(tmp_path, change, text):
    file = tmp_path / "pose.json"
    save_pose(file, "map", POSE, np.eye(6))
    whole = {} if change is None else json.loads(file.read_text()) | change
    file.write_text(json.dumps(whole))
    with pytest.raises(ValueError, match=text) as error:
        load_pose(file)
    assert str(file) in str(error.value)


def test_a_file_that_no_timer_would_save_or_start_from_is_refused():
    NodeConfig(saved_pose_file="pose.json")
    with pytest.raises(ValueError, match="saved_pose_file needs a tf_rate above 0"):
        NodeConfig(saved_pose_file="pose.json", tf_rate=0.0)
