"""How pictures move, and how sharp they are."""

from __future__ import annotations

import cv2
import numpy as np

from rs_localizer.mapping.views import Follower, sharpness
from rs_localizer.simulation.walls import collage

PICTURE = collage(900, 700, np.random.default_rng(0))


def test_the_motion_of_a_picture_is_found() -> None:
    """Turned, enlarged and shifted as a hand does, in pixels of the full image."""
    motion = np.vstack([cv2.getRotationMatrix2D((320.0, 240.0), 3.0, 1.03), [0.0, 0.0, 1.0]])
    motion[:2, 2] += (14.0, -9.0)
    size = (640, 480)
    into = np.array([[1.0, 0.0, -100.0], [0.0, 1.0, -100.0], [0.0, 0.0, 1.0]])
    first = cv2.warpPerspective(PICTURE, into, size)
    second = cv2.warpPerspective(PICTURE, motion @ into, size)
    follower = Follower()
    assert np.array_equal(follower.follow(first), np.eye(3))
    found = follower.follow(second)
    corners = np.array([[0.0, 639.0, 639.0, 0.0], [0.0, 0.0, 479.0, 479.0], [1.0] * 4])
    assert np.abs((found - motion) @ corners).max() < 1.0


def test_nothing_is_followed_on_a_blank_wall() -> None:
    follower = Follower()
    follower.follow(PICTURE[:480, :640])
    assert np.isnan(follower.follow(np.full((480, 640), 128, np.uint8))).all()
    assert np.isnan(follower.follow(PICTURE[:480, :640])).all()


def test_blur_is_less_sharp() -> None:
    blurred = np.asarray(cv2.blur(PICTURE, (9, 1)), np.uint8)
    assert sharpness(blurred) < 0.6 * sharpness(PICTURE)
