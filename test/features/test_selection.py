# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every part of an image keeps some of its keypoints, and the best ones."""

import numpy as np
import pytest

from rs_localizer.features.extraction import balanced


@pytest.mark.parametrize("size", [(640, 480), (479, 641), (300, 1000)])
def test_dim_parts_keep_keypoints(size):
    rng = np.random.default_rng(1)
    # Bright on the left tenth, dim elsewhere.
    bright = rng.uniform((0, 0), (0.1 * size[0], size[1]), (2000, 2))
    dim = rng.uniform((0.1 * size[0], 0), size, (2000, 2))
    pixels = np.vstack([bright, dim])
    scores = np.concatenate([rng.uniform(10, 11, 2000), rng.uniform(0, 1, 2000)])
    rows = balanced(pixels, scores, size, 500)
    assert len(rows) == len(set(rows.tolist())) == 500
    # By score alone there would be none.
    assert np.count_nonzero(rows >= 2000) > 350
    # Within a part they are the best.
    kept = scores[rows]
    assert kept[rows < 2000].min() > np.median(scores[:2000])
    assert kept[rows >= 2000].mean() > np.mean(scores[2000:]) + 0.2
