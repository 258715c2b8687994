# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is written for gsplat says where a rolling shutter sees points, in all four directions."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.neural_reconstruction import exposed_rows, write_gsplat

K = np.array([[500.0, 0.0, 321.5], [0.0, 510.0, 238.5], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 640, 480


def seen_by_gsplat(folder: Path, point: np.ndarray, shutter: str) -> np.ndarray:
    """Pixel (2,) of a point, the pose interpolated between both matrices by the row's time."""
    start, end = (np.load(folder / f"{name}.npy")[0] for name in ("viewmats", "viewmats_rs"))
    K = np.load(folder / "Ks.npy")[0]
    slerp = Slerp([0.0, 1.0], Rotation.from_matrix([start[:3, :3], end[:3, :3]]))
    pixel = np.array([WIDTH, HEIGHT]) / 2
    for _ in range(20):  # the row decides the pose, the pose the row
        time = {
            "ROLLING_TOP_TO_BOTTOM": (pixel[1] - 0.5) / (HEIGHT - 1),
            "ROLLING_BOTTOM_TO_TOP": 1.0 - (pixel[1] - 0.5) / (HEIGHT - 1),
            "ROLLING_LEFT_TO_RIGHT": (pixel[0] - 0.5) / (WIDTH - 1),
            "ROLLING_RIGHT_TO_LEFT": 1.0 - (pixel[0] - 0.5) / (WIDTH - 1),
        }[shutter]
        moved = (1.0 - time) * start[:3, 3] + time * end[:3, 3]
        pixel = through_the_lens(folder, slerp(time).apply(point) + moved, K)
    return pixel


def through_the_lens(folder: Path, point: np.ndarray, K: np.ndarray) -> np.ndarray:
    """By OpenCV, whose coefficients those of gsplat are."""
    names = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
    parts = [np.load(path)[0] for name in names if (path := folder / f"{name}.npy").exists()]
    nothing = np.zeros(3)
    if len(parts) == 1:
        return cv2.fisheye.projectPoints(point[None, None], nothing, nothing, K, parts[0])[
            0
        ].ravel()
    D = None
    if parts:
        radial, tangential, thin = parts
        D = np.concatenate([radial[:2], tangential, radial[2:], thin])
    return cv2.projectPoints(point, nothing, nothing, K, D)[0].ravel()


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", []), ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.03]),
        ("rational_polynomial", [0.1, -0.05, 0.001, 0.002, 0.03, 0.02, 0.01, -0.01]),
        ("equidistant", [0.02, -0.01, 0.003, 0.001]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("direction", list(ScanDirection))
def test_projection(tmp_path, direction, model, D):
    camera = Camera(WIDTH, HEIGHT, K, D, model, readout_time=0.03, scan_direction=direction)
    motion = Motion(
        Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.1, -0.2, 0.3]),
        np.array([0.006, -0.008, 0.005]), np.array([0.01, 0.006, -0.004]),
    )  # fmt: skip
    first, last = exposed_rows(camera)
    assert (first, last) == pytest.approx((-0.5, 0.5), abs=1e-12)
    poses = np.tile(np.eye(4), (1, 3, 1, 1))
    for k, tau in enumerate((first, 0.0, last)):
        rotation, translation = motion.at(tau)
        poses[0, k, :3, :3], poses[0, k, :3, 3] = rotation.T, -rotation.T @ translation
    points = np.random.default_rng(0).uniform([-0.8, -0.6, 2.0], [0.8, 0.6, 4.0], (30, 3))
    write_gsplat(tmp_path, camera, ["images/1.jpg"], poses, points)
    for k, name in ((0, "viewmats"), (2, "viewmats_rs")):
        rotation, translation = motion.at((first, 0.0, last)[k])
        view = np.load(tmp_path / f"{name}.npy")[0]
        np.testing.assert_allclose(view[:3], np.c_[rotation, translation], atol=1e-12)
    shutter = (tmp_path / "shutter.txt").read_text().strip()
    pixels, _ = project_rolling(camera, motion.at_rows, points)
    found = np.array([seen_by_gsplat(tmp_path, point, shutter) for point in points])
    np.testing.assert_allclose(found, pixels + 0.5, atol=0.01)


def test_a_model_of_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    D = np.array([0.1, -0.05, 0.001, 0.002, 0.03])
    camera = Camera(WIDTH, HEIGHT, K, D)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    pose[:3, 3] = [1.0, 2.0, 3.0]
    points = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0]])
    write_gsplat(tmp_path, camera, ["a.jpg", "b.jpg"], np.tile(pose, (2, 3, 1, 1)), points)
    assert (tmp_path / "shutter.txt").read_text() == "GLOBAL\n"
    model = pycolmap.Reconstruction(str(tmp_path))
    assert {image.name for image in model.images.values()} == {"a.jpg", "b.jpg"}
    assert len(model.points3D) == 2
    (lens,) = model.cameras.values()
    np.testing.assert_allclose(lens.params, [500, 510, 322, 239, *D[:4], D[4], 0, 0, 0])
    image = next(iter(model.images.values()))
    np.testing.assert_allclose(image.projection_center(), pose[:3, 3])
    seen = lens.img_from_cam(image.cam_from_world() * points[0])
    inverse = np.linalg.inv(pose)
    expected = camera.project((inverse[:3, :3] @ points[0] + inverse[:3, 3])[None])[0] + 0.5
    np.testing.assert_allclose(seen, expected, atol=1e-6)


def test_coefficients_that_colmap_cannot_say_are_refused(tmp_path):
    """Twelve were once cut to eight."""
    camera = Camera(WIDTH, HEIGHT, K, np.full(12, 0.01), "rational_polynomial")
    with pytest.raises(ValueError, match=r"COLMAP knows 8 coefficients .* the lens has 12"):
        write_gsplat(tmp_path, camera, ["a"], np.eye(4)[None, None].repeat(3, 1), np.zeros((0, 3)))
