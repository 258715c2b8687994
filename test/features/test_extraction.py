# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints lie where the picture has them, and are described as COLMAP does."""

from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from rs_localizer.features.extraction import FeatureExtractor, choose_balanced
from rs_localizer.tools.simulation.walls import collage

# OpenCV 5 has AKAZE in its contrib modules only.
KINDS = [
    pytest.param(kind, marks=[] if kind != "akaze" or hasattr(cv2, "AKAZE") else pytest.mark.skip)
    for kind in ("sift", "orb", "akaze")
]


@cache
def look() -> Any:
    """A picture (300,400) of discs, boxes and letters of all sizes, with noise."""
    return collage(400, 300, np.random.default_rng(7))


@cache
def blobs() -> tuple[Any, Any]:
    """An image of round blobs of four sizes, and their middles (n,2)."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[30:300:48, 30:400:48]
    middles = np.column_stack([u.ravel(), v.ravel()]) + rng.uniform(-0.5, 0.5, (u.size, 2))
    y, x = np.mgrid[:300, :400]
    image = np.full((300, 400), 40.0)
    for (px, py), width in zip(middles, np.resize([1.5, 2.5, 4.0, 6.0], u.size), strict=True):
        image += 150.0 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * width**2))
    return np.rint(image).astype(np.uint8), middles


def mutual(ours: Any, others: Any) -> tuple[Any, Any]:
    """Pairs of descriptors that are each other's nearest."""
    apart = cdist(ours, others)
    there, back = apart.argmin(1), apart.argmin(0)
    rows = np.flatnonzero(back[there] == np.arange(len(there)))
    return rows, there[rows]


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[2]])
def test_blobs_are_found_in_their_middle(kind):
    image, middles = blobs()
    found = FeatureExtractor(kind, 1000).extract(image)
    off = found.pixels[:, None] - middles
    nearest = np.linalg.norm(off, axis=2).argmin(1)
    errors = off[np.arange(len(found)), nearest]
    errors = errors[np.linalg.norm(errors, axis=1) < 1.0]
    assert len(errors) > 40
    # OpenCV's own SIFT is 0.25 px off to the right and down.
    assert np.abs(np.median(errors, axis=0)).max() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_image_gives_the_same_bits(kind):
    threads, results = cv2.getNumThreads(), []
    try:
        for count in (1, 2, threads):
            cv2.setNumThreads(count)
            found = FeatureExtractor(kind, 300).extract(look())
            results.append([a.tobytes() for a in (found.pixels, found.scores, found.descriptors)])
    finally:
        cv2.setNumThreads(threads)
    assert results == results[:1] * 3


def test_sift_is_colmaps():
    pycolmap = pytest.importorskip("pycolmap")
    image = look()
    theirs, values = pycolmap.Sift().extract(image)
    described = np.rint(512.0 * values) if values.dtype.kind == "f" else values
    ours = FeatureExtractor("sift", 3000).extract(image)
    rows, columns = mutual(ours.descriptors, described)
    # COLMAP has the corner of the first pixel at 0, 0.
    off = theirs[columns, :2] - 0.5 - ours.pixels[rows]
    near = np.linalg.norm(off, axis=1) < 0.5
    assert near.sum() > 0.55 * min(len(ours), len(theirs))
    assert np.abs(np.median(off[near], axis=0)).max() < 0.03
    apart = np.linalg.norm(ours.descriptors[rows[near]] - described[columns[near]], axis=1)
    assert np.median(apart) < 80.0  # of 512, the length of each


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (15, 40), (16, 16), (17, 200), (33, 64)])
def test_small_images(kind, shape):
    noise = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    extractor = FeatureExtractor(kind, 50)
    for image in (noise, np.zeros(shape, np.uint8)):
        found = extractor.extract(image)
        assert len(found) == len(found.scores) == len(found.sizes) == len(found.descriptors)
        assert found.descriptors.shape[1] in (32, 61, 128)
        assert np.all((found.pixels > -1.0) & (found.pixels < np.array(shape[::-1])))


@pytest.mark.parametrize("size", [(640, 480), (300, 1000)])
def test_dim_parts_keep_keypoints(size):
    rng = np.random.default_rng(1)
    # Bright on the left tenth, dim elsewhere.
    bright = rng.uniform((0, 0), (0.1 * size[0], size[1]), (2000, 2))
    dim = rng.uniform((0.1 * size[0], 0), size, (2000, 2))
    pixels = np.vstack([bright, dim])
    scores = np.concatenate([rng.uniform(10, 11, 2000), rng.uniform(0, 1, 2000)])
    rows = choose_balanced(pixels, scores, size, 500)
    assert len(rows) == len(set(rows.tolist())) == 500
    # By score alone there would be none.
    assert np.count_nonzero(rows >= 2000) > 350
    # Within a part they are the best.
    kept = scores[rows]
    assert kept[rows < 2000].min() > np.median(scores[:2000])
    assert kept[rows >= 2000].mean() > np.mean(scores[2000:]) + 0.2
