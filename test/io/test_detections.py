# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of tag detectors: corners in our order and pixels, and what is no such message."""

from types import SimpleNamespace as Made

import numpy as np
import pytest

from rs_localizer.io.detections import read_detections
from rs_localizer.io.messages import MessageError

# apriltag: from the lower left on, counter-clockwise; the first pixel's middle is at 0.5.
CORNERS = [(10.5, 40.5), (40.5, 40.5), (40.5, 10.5), (10.5, 10.5)]


def message(corners=CORNERS, **changed):
    points = [Made(x=x, y=y) for x, y in corners]
    tag = Made(**({"family": "36h11", "id": 7, "corners": points} | changed))
    header = Made(stamp=Made(sec=3, nanosec=5))
    return Made(header=header, detections=[tag])


def test_a_tag():
    found = read_detections(message())
    assert found.stamp_ns == 3_000_000_005
    assert found.names == [("tag36h11", 7)]
    expected = [(10, 10), (40, 10), (40, 40), (10, 40)]
    np.testing.assert_array_equal(found.corners[0], expected)


@pytest.mark.parametrize("family", ["tag36h11", "tag_36h11", "36h11"])
def test_families_have_one_name(family):
    assert read_detections(message(family=family)).names == [("tag36h11", 7)]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (message(CORNERS[:3]), "a detection has 3 corners, not 4"),
        (message([(np.nan, 0.0), *CORNERS[1:]]), "corners of a detection are not finite"),
        (Made(header=message().header, detections=[Made()]), "a detection has no field corners"),
        (Made(detections=range(10_001)), "10001 detections are no tags of one image"),
    ],
)
def test_what_was_found_is_said(wrong, said):
    with pytest.raises(MessageError, match=said):
        read_detections(wrong)
