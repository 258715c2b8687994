# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Deviations of a shape, wherever the whole of it lies."""

import numpy as np
from scenes import SQUARE
from scipy.spatial.transform import Rotation

from rs_localizer.mapping.gauge import of_the_shape

COUNT = 4


def moved_by(corners: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Changes (6 m,) of places and turns when all move by a shift and a turn about zero (6,)."""
    turn = Rotation.from_rotvec(motion[3:]).as_matrix()
    middles = corners.mean(axis=1)
    places = middles @ turn.T + motion[:3] - middles
    return np.concatenate([np.concatenate([place, motion[3:]]) for place in places])


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


def test_motions_of_the_whole_do_not_count():
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(COUNT, 4, 3))
    motions = np.array([moved_by(corners, 1e-5 * of) for of in np.eye(6)]).T * 1e5
    root = rng.normal(size=(6 * COUNT, 6 * COUNT))
    covariance = root @ root.T
    floating = covariance + 1e3 * motions @ motions.T
    np.testing.assert_allclose(
        of_the_shape(floating, corners), of_the_shape(covariance, corners), atol=0.2
    )
