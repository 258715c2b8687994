# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of known size are found, and the worst frame is in the picture."""

import cv2
import numpy as np

from rs_localizer.tools import errors


def test_picture_has_a_colored_curve_for_each_method(tmp_path):
    values = np.full(400, 0.01)
    values[77] = 30.0
    one = errors.Errors(np.arange(400) * 10**8, values)
    found = {"position": one, "orientation": one}
    errors.draw({"ours": found, "p3p": found}, tmp_path / "both.png")
    errors.draw({"ours": found}, tmp_path / "one.png")
    both, alone = (cv2.imread(str(tmp_path / name)) for name in ("both.png", "one.png"))
    assert both.shape == alone.shape
    orange = both[..., 2].astype(int) - both[..., 0] > 60
    assert orange.sum() > 1000
    assert not (alone[..., 2].astype(int) - alone[..., 0] > 60).any()
