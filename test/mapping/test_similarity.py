# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Similarities."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.mapping.gauge import Similarity, through


def test_the_similarity_through_points_is_found():
    rng = np.random.default_rng(0)
    given = Similarity(2.5, Rotation.random(random_state=1).as_matrix(), rng.normal(size=3))
    points = rng.normal(size=(9, 3))
    found = through(points, given(points))
    assert found.scale == pytest.approx(given.scale)
    assert np.allclose(found.rotation, given.rotation)
    assert np.allclose(found.translation, given.translation)


def test_points_of_a_plane_are_not_mirrored():
    points = np.random.default_rng(0).normal(size=(8, 3)) * (1.0, 1.0, 0.0)
    turn = Rotation.from_euler("xyz", [170.0, 20.0, 40.0], degrees=True).as_matrix()
    assert np.allclose(through(points, points @ turn.T).rotation, turn)


@pytest.mark.parametrize("points", [np.eye(3)[:2], np.outer(np.arange(5.0), [1.0, 2.0, 3.0])])
def test_too_few_and_points_on_a_line_are_refused(points):
    with pytest.raises(ValueError, match="determine"):
        through(points, points)
