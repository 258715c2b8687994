# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The lens and the COLMAP model that are written for gsplat.

Poses of both ends of the shutter: ``test/cli/test_replay_exports.py``.
"""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.io.neural_reconstruction import write_gsplat

K = np.array([[500.0, 0.0, 321.5], [0.0, 510.0, 238.5], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 640, 480


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", []), ("plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.03]),
        ("rational_polynomial", [0.1, -0.05, 0.001, 0.002, 0.03, 0.02, 0.01, -0.01]),
        ("equidistant", [0.02, -0.01, 0.003, 0.001]),
    ],
)  # fmt: skip
def test_the_lens_is_that_of_opencv(tmp_path, model, D):
    camera = Camera(WIDTH, HEIGHT, K, D, model)
    write_gsplat(tmp_path, camera, ["1.jpg"], np.eye(4)[None, None].repeat(3, 1), np.zeros((0, 3)))
    points = np.random.default_rng(0).uniform([-0.8, -0.6, 2.0], [0.8, 0.6, 4.0], (30, 3))
    (written,), zero = np.load(tmp_path / "Ks.npy"), np.zeros(3)
    names = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
    parts = [np.load(path)[0] for name in names if (path := tmp_path / f"{name}.npy").exists()]
    if len(parts) == 1:
        pixels, _ = cv2.fisheye.projectPoints(points[None], zero, zero, written, parts[0])
    else:
        radial, tangential, thin = parts or (np.zeros(6), np.zeros(2), np.zeros(4))
        lens = np.concatenate([radial[:2], tangential, radial[2:], thin])
        pixels, _ = cv2.projectPoints(points, zero, zero, written, lens)
    # The corner of the first pixel is at 0, 0.
    np.testing.assert_allclose(pixels.reshape(-1, 2), camera.project(points) + 0.5, atol=1e-9)


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
    image = next(iter(model.images.values()))
    np.testing.assert_allclose(image.projection_center(), pose[:3, 3])
    seen = lens.img_from_cam(image.cam_from_world() * points[0])
    local = (points[:1] - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(seen, camera.project(local)[0] + 0.5, atol=1e-6)


def test_coefficients_that_colmap_cannot_say_are_refused(tmp_path):
    """Twelve were once cut to eight."""
    camera = Camera(WIDTH, HEIGHT, K, np.full(12, 0.01), "rational_polynomial")
    with pytest.raises(ValueError, match=r"COLMAP knows 8 coefficients .* the lens has 12"):
        write_gsplat(tmp_path, camera, ["a"], np.eye(4)[None, None].repeat(3, 1), np.zeros((0, 3)))
