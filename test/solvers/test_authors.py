# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The solvers that the authors' C++ has, against what it printed (``authors.cpp`` says how)."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.solvers.minimal import solve_minimal

ITERATIONS = (1, 2, 5)


@pytest.fixture(scope="module")
def stored():
    """16 samples at 1e-3 of noise; their row time is x."""
    return SimpleNamespace(**np.load(Path(__file__).parent / "authors.npz"))


def models(found):
    """Rotation vectors, C, w and t (n,12) of theirs: v, C, w, t."""
    length = np.linalg.norm(found[:, :3], axis=1, keepdims=True)
    turn = found[:, :3] / length * np.arctan(length)  # of the rotation nearest to I + [v]x
    return np.hstack([turn, found[:, 3:]])


def solved(name, stored, **options):
    """As :func:`models`, (h,k,12)."""
    rotations, *others = solve_minimal(
        name, stored.points, stored.rays, np.ascontiguousarray(stored.rays[..., 0]), **options
    )
    turns = np.full(others[0].shape, np.nan)
    there = np.isfinite(others[0][..., 0])
    turns[there] = Rotation.from_matrix(rotations[there]).as_rotvec()
    return np.concatenate([turns, *others], axis=2)


@pytest.mark.parametrize("k", range(len(ITERATIONS)))
def test_vcwt_as_published_is_the_authors(stored, k):
    ours = solved("r6p_vcwt", stored, iterations=ITERATIONS[k], as_published=True)[:, 0]
    np.testing.assert_allclose(ours, models(stored.iterated[:, k]), rtol=1e-8, atol=1e-9)


def test_the_first_iteration_is_also_that_of_the_relinearized_one(stored):
    ours = solved("r6p_vcwt", stored, iterations=1)[:, 0]
    np.testing.assert_allclose(ours, models(stored.iterated[:, 0]), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("bound", [0.3, 1.0, 10.0])
def test_r6p_finds_the_authors_solutions_and_no_others(stored, bound):
    ours = solved("r6p", stored, bound=bound)
    theirs = models(stored.solutions)
    near = np.linalg.norm(stored.solutions[:, :3], axis=1) < bound
    for sample in range(len(ours)):
        expected = theirs[near & (stored.sample == sample)]
        found = ours[sample][np.isfinite(ours[sample, :, 0])]
        assert len(found) == len(expected)
        apart = np.abs(found[:, None] - expected).max(axis=2) / (1.0 + np.abs(expected).max(axis=1))
        assert (apart.min(axis=0) < 1e-6).all()
        assert (apart.min(axis=1) < 1e-6).all()
