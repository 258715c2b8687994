# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP in a process of its own: what it is given, and what becomes of one that dies."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import colmap_camera, colmap_parameters
from rs_localizer.tools.mapping import structure as structures
from rs_localizer.tools.mapping.refinement import global_errors
from rs_localizer.tools.mapping.structure import build_structure, image_name, pairs_of
from rs_localizer.tools.simulation.walls import collage

K = np.array([[260.0, 0.0, 161.0], [0.0, 255.0, 118.0], [0.0, 0.0, 1.0]])


def test_of_many_images_neighbours_are_matched_and_some_with_all():
    pairs = set(pairs_of(300))
    assert len(pairs) < 300 * 20
    assert all((i, i + step) in pairs for i in range(200) for step in (1, 5, 10, 64))
    # Any two times that are far apart have a pair near them, so that loops close.
    assert all(
        any((a, b) in pairs for a in range(i - 5, i + 6) for b in range(j - 5, j + 6))
        for i, j in ((30, 280), (17, 171), (99, 205))
    )


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", [0.1, -0.02, 1e-3, -2e-3, 0.0]),
        ("plumb_bob", [0.1, -0.02, 1e-3, -2e-3, 0.01]),
        ("plumb_bob", []),
        ("rational_polynomial", [0.1, -0.02, 1e-3, -2e-3, 0.01, 0.02, 0.03, 0.04]),
        ("equidistant", [0.1, -0.02, 1e-3, -2e-3]),
    ],
)
def test_the_lens_is_the_same_for_colmap(model, D):
    """There and back, as it sees points."""
    camera = Camera(320, 240, K, np.array(D), model)
    known = colmap_parameters(camera)
    line = " ".join(map(repr, known["params"]))
    back = colmap_camera(f"1 {known['model']} 320 240 {line}", None)
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.5], (50, 3))
    np.testing.assert_allclose(back.project(points), camera.project(points), atol=1e-9)


def build(images: Path, folder: Path, count: int) -> structures.Structure:
    folder.mkdir()
    rows = {k: k for k in range(count)}
    return build_structure(images, rows, None, folder)


def test_a_process_that_dies_is_named(tmp_path, monkeypatch):
    dying = tmp_path / "dying.py"
    dying.write_text(
        "import os, sys\nsys.stderr.write('free(): invalid pointer\\n')\n"
        "sys.stderr.flush()\nos.abort()\n"
    )
    monkeypatch.setattr(structures, "_SCRIPT", dying)
    with pytest.raises(ValueError, match=r"ended with signal SIGABRT: free\(\): invalid pointer"):
        build(tmp_path, tmp_path / "out", 3)


def test_pycolmap_stays_out_of_this_process():
    """OpenCV is in it; both together abort on some machines."""
    pytest.importorskip("pycolmap")
    code = (
        "import sys, cv2, rs_localizer.tools.mapping.build\n"
        "import rs_localizer.tools.mapping.structure as c\n"
        "c.require()\nassert 'pycolmap' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_plane_and_a_box_are_mapped_without_a_calibration(tmp_path):
    """Two textured planes at different depths: COLMAP finds poses, points and the focal length."""
    pytest.importorskip("pycolmap")
    images = tmp_path / "images"
    images.mkdir()
    count, size, focal = 9, (480, 360), 420.0
    M = np.array([[focal, 0.0, 239.5], [0.0, focal, 179.5], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    planes = [(collage(1100, 900, rng), 5.0, 0.008), (collage(300, 300, rng), 3.0, 0.004)]
    centres = []
    for k in range(count):
        angle = 0.09 * (k - 4)
        turn = cv2.Rodrigues(np.array([0.01 * k, angle, 0.0]))[0]
        centre = np.array([4.0 * np.sin(angle), 0.1 * k, 4.0 - 4.0 * np.cos(angle)])
        centres.append(centre)
        image = np.full(size[::-1], 90, np.uint8)
        for texture, depth, pixel in planes:
            h, w = texture.shape
            # Texture's pixels -> the plane at this depth -> the image.
            plane = np.diag([pixel, pixel, 0.0])
            plane[:, 2] = np.array([-pixel * w / 2, -pixel * h / 2, depth]) - centre
            H = M @ turn @ plane
            there = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA)
            mask = cv2.warpPerspective(np.full_like(texture, 255), H, size)
            image[mask > 250] = there[mask > 250]
        cv2.imwrite(str(images / image_name(k)), image, [cv2.IMWRITE_JPEG_QUALITY, 97])
    structure = build(images, tmp_path / "out", count)
    assert structure.parts == (count,)
    assert structure.camera.K[0, 0] == pytest.approx(focal, rel=0.03)
    assert structure.descriptors.shape == (len(structure.start.points), 128)
    # Positions have the true shape.
    true, found = np.array(centres), structure.start.positions
    steps = [np.linalg.norm(of - of[0], axis=1)[1:] for of in (true, found)]
    ratios = steps[1] / steps[0]
    assert np.ptp(ratios) < 0.05 * np.median(ratios)
    # Observations are where the points project to.
    errors = global_errors(structure.camera, structure.seen, structure.start)
    assert np.mean(errors) < 0.7
