"""Corners from edges: exact wherever in the pixels an edge lies, however sharp it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rs_localizer.markers.edges import refine


def square(left: float, top: float, side: float, blur: float = 0.0) -> np.ndarray:
    """A black square on white (80, 80), each pixel the mean of the light that falls on it."""
    inside = [
        np.clip(np.minimum(np.arange(80) + 0.5, start + side) -
                np.maximum(np.arange(80) - 0.5, start), 0.0, 1.0)
        for start in (left, top)
    ]  # fmt: skip
    image = 220.0 - 190.0 * inside[1][:, None] * inside[0]
    return cv2.GaussianBlur(image, (0, 0), blur) if blur > 0.0 else image


def error(image: np.ndarray, left: float, top: float, side: float) -> float:
    """The largest error (px) of the four corners, from a start that is half a pixel off."""
    low, right, bottom = np.array([left, top]), left + side, top + side
    truth = np.array([low, [right, top], [right, bottom], [left, bottom]])
    quads = (truth + np.array([[0.4, -0.3], [-0.5, 0.2], [0.3, 0.5], [-0.2, -0.4]]))[None]
    gray = np.ascontiguousarray(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert np.all(refine(gray, quads, np.array([8])))
    return float(np.abs(quads[0] - truth).max())


@pytest.mark.parametrize("blur", [0.0, 0.5, 1.0])
def test_an_edge_along_the_pixels_is_where_it_is(blur: float) -> None:
    """Weights by the squared slope draw a sharp edge to the middle of a pixel: 0.15 px."""
    for offset in np.linspace(0.0, 0.95, 20):
        left, top, side = 20.0 + offset, 22.0 - 0.7 * offset, 36.3
        assert error(square(left, top, side, blur), left, top, side) < 0.015


def test_noise_costs_hundredths_of_a_pixel() -> None:
    rng, errors = np.random.default_rng(0), []
    for _ in range(40):
        left, top = 20.0 + rng.uniform(0.0, 1.0, 2)
        image = square(left, top, 36.0, 0.7) + rng.normal(0.0, 4.0, (80, 80))
        errors.append(error(image, left, top, 36.0))
    assert np.median(errors) < 0.053
