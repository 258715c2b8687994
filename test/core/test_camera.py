# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
from contextlib import nullcontext

import cv2
import numpy as np
import pytest

from rs_localizer.core.bearings import bearings, projected
from rs_localizer.core.camera import Camera, Roi

K = np.array([[500.0, 0.0, 321.0], [0.0, 510.0, 238.0], [0.0, 0.0, 1.0]])
CURVED = [0.5, 0.1, 0.001, 0.001, 0.01, 0.8, 0.2, 0.03]
LENSES = [
    ("plumb_bob", []),
    ("plumb_bob", [-0.3, 0.1, 0.002, -0.001]),
    ("plumb_bob", [-0.3, 0.1, 0.002, -0.001, 0.01]),
    ("plumb_bob", [0.4, 0.1, 0.002, -0.001, 0.01]),
    ("rational_polynomial", CURVED),
    ("rational_polynomial", [*CURVED, 0.01, 0.003, -0.02, 0.004]),
    ("rational_polynomial", [*CURVED, 0.01, 0.003, -0.02, 0.004, 0.02, -0.03]),
    ("equidistant", [0.05, 0.01, 0.001, 0.0]),
]
PART = {"binning": (2, 3), "roi": Roi(100, 60, 400, 300)}
DIRECTIONS = ["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]


def camera(**changes):
    return Camera(**({"width": 640, "height": 480, "K": K} | changes))


def pixels(count=200, seed=0):
    return np.random.default_rng(seed).uniform([0, 0], [639, 479], (count, 2))


@pytest.mark.parametrize(
    ("size", "K", "said"),
    [
        ((480, 640), (500.0, 510.0, 319.5, 239.5),
         "of 640x480, not of 480x640: are width and height exch"),
        ((480, 640), (500.0, 510.0, 239.5, 319.5), ""),  # a lens that is turned with its image
        ((480, 640), (500.0, 510.0, 319.5, 300.0), ""),  # one that is mounted beside the middle
        ((640, 480), (0.78, 1.04, 0.5, 0.5), r"not in pixels: focal lengths 0\.78, 1\.04, "),
        ((16, 16), (5.0, 5.0, 7.5, 7.5), ""),  # a wide lens on a small image
        ((640, 480), (500.0, 500.0, 0.5, 0.5), ""),  # a corner in the middle of the view
        *((size, (500.0, 500.0, 0.5 * size[0], 0.5 * size[1]), "at most 65536 pixels wide and high")
          for size in ((70_000, 480), (2**31, 480), (640, 2**31))),
    ],
)  # fmt: skip
def test_a_matrix_of_another_image_is_named(size, K, said):
    fx, fy, cx, cy = K
    with pytest.raises(ValueError, match=said) if said else nullcontext():
        Camera(*size, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_rays_lead_back_to_their_pixels_by_opencv(model, D):
    raw = pixels()
    rays = camera(D=D, distortion_model=model).rays(raw)
    there = np.column_stack([rays, np.ones(len(rays))])[:, None]
    zero = np.zeros(3)
    if model == "equidistant":
        back = cv2.fisheye.projectPoints(there, zero, zero, K, np.array(D))[0][:, 0]
    else:
        back = cv2.projectPoints(there, zero, zero, K, np.array(D))[0][:, 0]
    np.testing.assert_allclose(back, raw, atol=1e-6)


@pytest.mark.parametrize("D", [None, [], [0.0, 0.0, 0.0, 0.0]])
def test_a_fisheye_without_coefficients_is_no_pinhole(D):
    points = np.array([[1.0, 0.0, 1.0], [-0.2, 0.5, 2.0]])
    zero, none = np.zeros(3), np.zeros(4)
    expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, none)[0][:, 0]
    seen = camera(D=D, distortion_model="equidistant").project(points)
    np.testing.assert_allclose(seen, expected, atol=1e-9)


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_projecting_undoes_rays_also_with_binning_and_roi(model, D):
    cropped = camera(D=D, distortion_model=model, **PART)
    raw = np.random.default_rng(1).uniform([0, 0], [199, 99], (50, 2))
    rays = cropped.rays(raw)
    points = 3.0 * np.column_stack([rays, np.ones(len(rays))])
    np.testing.assert_allclose(cropped.project(points), raw, atol=1e-6)
    # The bearing is that of the pixel on the full sensor.
    on_sensor = raw * (2, 3) + (100, 60)
    np.testing.assert_allclose(
        rays, camera(D=D, distortion_model=model).rays(on_sensor), atol=1e-12
    )


@pytest.mark.parametrize(("model", "D"), LENSES)
@pytest.mark.parametrize("part", [{}, PART])
def test_kernels_of_many_pixels_and_differences_give_the_same(model, D, part):
    """203: some blocks of lanes, and a part of one."""
    lens = camera(D=D, distortion_model=model, **part)
    raw = pixels(203) / lens.binning
    for ours, theirs in zip(bearings(lens, raw), lens.rays_and_jacobian(raw), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-9)
    rays = lens.rays(raw)
    for ours, theirs in zip(projected(lens, rays), lens.distort(rays), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-9)
    ahead, behind = (
        np.stack([lens.distort(rays + step)[0] for step in side * np.eye(2)], axis=2)
        for side in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(lens.pixel_jacobian(rays), (ahead - behind) / 2e-5, atol=1e-3)


def test_what_has_no_bearing_has_none_and_harms_no_neighbour():
    strong = camera(D=[-0.5, 0.0, 0.0, 0.0, 0.0])
    raw = np.array([321.0, 238.0]) + 0.3 * (pixels(19) - (320, 240))
    # The polynomial r (1 - r^2/2) never exceeds 0.55: no bearing reaches these pixels.
    raw[[2, 5]] = [1500.0, 238.0], [321.0, -900.0]
    rays, _ = bearings(strong, raw)
    np.testing.assert_array_equal(np.isnan(rays[:, 0]), np.isin(np.arange(19), [2, 5]))
    np.testing.assert_allclose(rays, strong.rays(raw), rtol=1e-7, atol=1e-9)
    assert [a.shape for a in bearings(strong, np.zeros((0, 2)))] == [(0, 2), (0, 2, 2)]
    assert np.isnan(camera().project(np.array([[0.0, 0.0, -1.0], [0.1, 0.0, 0.0]]))).all()


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_row_time_of_a_crop_is_that_of_the_sensor_row(direction):
    cropped = camera(binning=(2, 2), roi=Roi(100, 60, 400, 300), scan_direction=direction)
    whole = camera(scan_direction=direction)
    raw = np.array([[0.0, 0.0], [10.0, 20.0], [199.5, 149.5]])
    np.testing.assert_allclose(
        cropped.row_time(raw), whole.row_time(raw * 2 + (100, 60)), atol=1e-15
    )
    corners = np.array([[0.0, 0.0], [199.5, 149.5]])
    assert cropped.first_row_time == pytest.approx(cropped.row_time(corners).min())
    assert whole.first_row_time == -0.5
    gradient = cropped.row_time(np.eye(2)) - cropped.row_time(np.zeros((1, 2)))
    np.testing.assert_allclose(cropped.row_time_gradient, gradient, atol=1e-15)


def test_inside_is_the_area_of_the_pixels():
    assert camera().inside(
        np.array([[-0.4, -0.4], [639.4, 479.4], [-0.6, 3], [3, 479.6], [np.nan, 3]])
    ).tolist() == [True, True, False, False, False]
    binned = camera(binning=(2, 3), roi=Roi(0, 0, 400, 300))
    assert binned.size == (200, 100)
    assert binned.focal_length == pytest.approx(np.sqrt(250.0 * 170.0))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"K": np.zeros((3, 3))}, "not calibrated: focal lengths are 0, 0"),
        ({"D": [0.1, 0.2]}, "plumb_bob takes 0 or 4 or 5 coefficients, got 2"),
        ({"distortion_model": "fov"}, "one of plumb_bob, .*; got 'fov'"),
        ({"readout_time": 30}, r"at most 0\.5 s, got 30: it is in seconds; 30 ms are 0.03"),
        ({"readout_time": 0.9}, r"at most 0\.5 s, got 0\.9"),
        ({"K": None}, "K must be numbers, got None"),
        ({"binning": 2}, "binning must be two numbers of 1 or more, got 2"),
        ({"binning": (2,)}, "binning must be two numbers"),
        ({"roi": (0, 0, 5, 5)}, "roi must be of type Roi, got tuple"),
        ({"roi": Roi(0, 0, 700, 480)}, "does not lie on a sensor of 640x480"),
    ],
)
def test_an_impossible_camera_is_refused_with_what_was_found(changes, said):
    with pytest.raises(ValueError, match=said):
        camera(**changes)


def test_what_people_and_files_give_is_taken():
    """Lists, nine numbers as camera_info has them, no distortion, and sizes as JSON has them."""
    K = [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
    camera = Camera(1280.0, np.int64(720), K, None)
    assert (camera.width, camera.height) == (1280, 720)
    assert type(camera.width) is int
    assert camera.D.shape == (0,)
    np.testing.assert_array_equal(camera.K, np.array(K, float))
    np.testing.assert_array_equal(Camera(640, 480, np.ravel(K).tolist()).K, camera.K)
    assert Camera(640, 480, K, [0.1, 0, 0, 0]).D.tolist() == [0.1, 0, 0, 0]
