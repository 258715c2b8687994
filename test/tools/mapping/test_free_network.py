# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Deviations of a shape, wherever the whole of it lies."""

import numpy as np
from scenes import SQUARE
from scipy.spatial.transform import Rotation

from rs_localizer.tools.mapping.gauge import of_the_shape

COUNT = 4


def test_it_is_what_is_left_when_the_markers_are_laid_over_the_truth():
    rng = np.random.default_rng(0)
    turns = Rotation.random(COUNT, random_state=1).as_matrix()
    middles = rng.normal(size=(COUNT, 3))
    corners = 0.15 * np.einsum("mij,cj->mci", turns, SQUARE) + middles[:, None]
    root = 1e-4 * rng.normal(size=(6 * COUNT, 6 * COUNT))
    held = of_the_shape(root @ root.T, corners)
    left = []
    for _ in range(3000):
        error = (root @ rng.normal(size=6 * COUNT)).reshape(COUNT, 6)
        own = Rotation.from_rotvec(error[:, 3:])
        places = middles + error[:, :3]
        seen = own.as_matrix() @ np.swapaxes(corners - middles[:, None], 1, 2)
        ours = (np.swapaxes(seen, 1, 2) + places[:, None]).reshape(-1, 3)
        true = corners.reshape(-1, 3)
        back, _ = Rotation.align_vectors(true - true.mean(axis=0), ours - ours.mean(axis=0))
        over = back.apply(places - ours.mean(axis=0)) + true.mean(axis=0) - middles
        left.append(np.column_stack([over, (back * own).as_rotvec()]).ravel())
    np.testing.assert_allclose(np.std(left, axis=0), np.sqrt(np.diag(held)), rtol=0.07)
