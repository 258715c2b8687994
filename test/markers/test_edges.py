# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Corners from edges: exact wherever in the pixels an edge lies, sharp or smeared."""

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


def error(image: np.ndarray, left: float, top: float, side: float, cells: int = 8) -> float:
    """The largest error (px) of the four corners, from a start that is half a pixel off."""
    low, right, bottom = np.array([left, top]), left + side, top + side
    truth = np.array([low, [right, top], [right, bottom], [left, bottom]])
    return moved(image, truth, cells)


def moved(image: np.ndarray, truth: np.ndarray, cells: int) -> float:
    """The largest error (px) of corners (4,2), from a start that is half a pixel off."""
    quads = (truth + np.array([[0.4, -0.3], [-0.5, 0.2], [0.3, 0.5], [-0.2, -0.4]]))[None]
    gray = np.ascontiguousarray(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert np.all(refine(gray, quads, np.array([cells])))
    return float(np.abs(quads[0] - truth).max())


@pytest.mark.parametrize("blur", [0.0, 0.5, 1.0])
def test_an_edge_along_the_pixels_is_where_it_is(blur):
    """Weights by the squared slope draw a sharp edge to the middle of a pixel: 0.15 px."""
    for offset in np.linspace(0.0, 0.95, 20):
        left, top, side = 20.0 + offset, 22.0 - 0.7 * offset, 36.3
        assert error(square(left, top, side, blur), left, top, side) < 0.015


def ring(left: float, top: float, side: float, smear: tuple[float, float]) -> np.ndarray:
    """A square with a border of a cell, a sixth of its side, which moves by ``smear`` cells."""
    cell, steps = side / 6.0, (np.arange(60) + 0.5) / 60 - 0.5
    images = [
        square(left + dx, top + dy, side)
        + 220.0
        - square(left + dx + cell, top + dy + cell, side - 2.0 * cell)
        for dx, dy in cell * steps[:, None] * np.array(smear)
    ]
    return np.mean(images, axis=0)


@pytest.mark.parametrize("smear", [(0.7, 0.0), (1.05, 0.4), (0.7, -0.8)])
@pytest.mark.parametrize("side", [30.0, 45.3])
def test_a_smeared_edge_is_where_it_was_amid_the_exposure(smear, side):
    """Smeared by a cell, hardly any black is left between the white of both sides."""
    for offset in np.linspace(0.0, 0.9, 4):
        left, top = 18.0 + offset, 17.0 - 0.7 * offset
        image = ring(left, top, side, smear)
        assert error(image, left, top, side, cells=6) < 0.1


def test_the_sides_of_a_slanted_marker_keep_clear_of_each_other():
    """A rhomb of 25 degrees: its rows are a sixth of its height apart, not of its sides."""
    angle, side = np.deg2rad(25.0), 40.0
    along = side * np.array([[1.0, 0.0], [np.cos(angle), np.sin(angle)]])
    for shift in ((0.0, 0.0), (0.3, 0.6), (0.7, 0.2)):
        corner = np.array([3.0, 30.0]) + shift
        fine = (np.arange(640) + 0.5) / 8.0 - 0.5
        x, y = np.meshgrid(fine, fine)
        a, b = np.tensordot(np.linalg.inv(along.T), np.stack([x, y]) - corner[:, None, None], 1)
        inside = np.maximum(abs(a - 0.5), abs(b - 0.5)) < 1 / 2
        hole = np.maximum(abs(a - 0.5), abs(b - 0.5)) < 1 / 3
        image = 220.0 - 190.0 * (inside & ~hole).reshape(80, 8, 80, 8).mean(axis=(1, 3))
        truth = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ along
        assert moved(image, truth, cells=6) < 0.2
