"""Where the image should show the landmarks of a map, if the camera moves as predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.matching.descriptors import Visible
from rs_localizer.matching.kernels import in_view, move

# Standard deviations of the prediction within which the camera is looked for.
_DEVIATIONS = 3.0
# What one core of an AMD EPYC took, in ns: for a landmark, without and with a lens that bends, and
# for a landmark in the rows of a keypoint.
_PROJECTION_COST, _LENS_COST, _ROW_COST = 400.0, 1400.0, 1.8
# Pixels along each border of the image that bound its bearings.
_BORDER_PIXELS = 33


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What the image may show."""

    landmarks: IntArray  # (v,)
    gate: float  # px around the prediction


def find_view(camera: Camera, prior: Prior, points: Array, least_gate: float) -> View:
    """The landmarks that some row may see, and how far from the prediction.

    Args:
        camera: of the image.
        prior: predicted motion and its covariance.
        points: (n,3) of the map.
        least_gate: px; the gate is wider where the prediction is less certain than that.
    """
    assert prior.motion is not None
    assert prior.covariance is not None
    low, high = _bearings(camera)
    widest = 0.5 * math.hypot(*camera.size)
    focal = camera.focal_length
    slack = min(2.0 * least_gate, widest) / focal
    depths = np.empty(len(points))
    in_view(points, state_in(prior.motion, np.zeros(3)), low - slack, high + slack, depths)
    near = np.flatnonzero(depths)
    if len(near) == 0:
        return View(near, float(least_gate))
    deviation = focal * _bearing_deviation(prior.covariance, float(np.median(depths[near])))
    return View(near, float(min(max(least_gate, _DEVIATIONS * deviation), widest)))


def search_cost(camera: Camera, view: View, queries: int, candidate_cost: float) -> float:
    """What it takes to project the view and to search near the predictions, in ns.

    Args:
        camera: of the image.
        view: landmarks and gate.
        queries: number of keypoints.
        candidate_cost: ns for each landmark within the gate of a keypoint.
    """
    width, height = camera.size
    projection = _PROJECTION_COST if len(camera.D) == 0 else _LENS_COST
    rows = min(2.0 * view.gate / height, 1.0)
    area = min(math.pi * view.gate**2 / (width * height), 1.0)
    search = queries * (rows * _ROW_COST + area * candidate_cost)
    return len(view.landmarks) * (projection + search)


def predict(camera: Camera, prior: Prior, points: Array, view: View) -> Visible:
    """Where the image should show the landmarks of a view: each at the time of its own row."""
    assert prior.motion is not None
    near, gate = view.landmarks, view.gate
    if len(near) == 0:
        return Visible(near, np.zeros((0, 2)), gate)
    pixels = _project(camera, prior.motion, points[near])
    limit = np.array(camera.size) - 0.5 + gate
    inside = np.flatnonzero(np.all((pixels > -0.5 - gate) & (pixels < limit), axis=1))
    order = inside[np.argsort(pixels[inside, 1], kind="stable")]
    return Visible(near[order], pixels[order], gate)


def _project(camera: Camera, motion: Motion, points: Array) -> Array:
    """Raw pixels (n,2) of points (n,3), each at the time of its own row; NaN behind the camera.

    One step of what :func:`rs_localizer.core.shutter.project_rolling` does until no digit changes:
    to a small part of a pixel, in a fifth of the time.
    """

    state, moved = state_in(motion, np.zeros(3)), np.empty(points.shape)

    def view(tau: Array) -> Array:
        move(points, state, tau, moved)
        return camera.project(moved)

    rows = camera.row_time(view(np.zeros(len(points))))
    error = camera.row_time(view(rows)) - rows
    with np.errstate(all="ignore"):  # NaN, and points in the middle row
        step = -error * rows / (error - rows)
    return view(np.clip(rows + np.nan_to_num(step), -1.0, 1.0))


def _bearings(camera: Camera) -> tuple[Array, Array]:
    """Bounds (2,), (2,) of the bearings in the image; infinite where a lens sees sideways."""
    width, height = camera.size
    u = np.linspace(-0.5, width - 0.5, _BORDER_PIXELS)
    v = np.linspace(-0.5, height - 0.5, _BORDER_PIXELS)
    border = [
        *(np.column_stack([u, np.full_like(u, line)]) for line in (v[0], v[-1])),
        *(np.column_stack([np.full_like(v, column), v]) for column in (u[0], u[-1])),
    ]
    rays = camera.rays(np.concatenate(border))
    if not np.all(np.isfinite(rays)):
        return np.full(2, -np.inf), np.full(2, np.inf)
    return rays.min(axis=0), rays.max(axis=0)


def _bearing_deviation(covariance: Array, depth: float) -> float:
    """Standard deviation of the bearing of a point at this depth, at the first or last row."""
    turn, move, angular, linear = (
        float(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1]) for k in (0, 3, 6, 9)
    )
    return math.sqrt(turn + 0.25 * angular + (move + 0.25 * linear) / depth**2)
