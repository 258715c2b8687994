# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the poses of one video say of themselves: nobody knows the truth."""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.real.clips import Clip, Shutter, halved
from benchmarks.real.peers import PEERS, GlobalPose
from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.core.state import ANGULAR, POSE, VELOCITIES
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.localizer import Localizer
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tracking import FrameContext, Tracker

Pose = Estimate | GlobalPose
Poses = Sequence[Pose | Failure | None]
METHODS = ("default", "tracked", "single")
PEER = "solvepnp"
"""With which the methods are compared."""
# 95 % quantile of chi-squared with six degrees of freedom, and the median with three.
_INSIDE, _MEDIAN = 12.592, 2.366
_INSIDE_3 = 7.815  # likewise with three degrees of freedom
# Printed boards: by this part of the way from its middle a corner is off (0.2 mm in 10 cm).
_PAPER = 0.002


def judged(clip: Clip, lens: Camera, shutter: Shutter, config: NodeConfig) -> dict[str, float]:
    """One row of the table."""
    row: dict[str, float] = {"images": len(clip.images), "readout_ms": 1e3 * shutter.readout_time}
    if config.map_deviation == 0.0:  # nobody measured the board
        apart = clip.images[0].points - clip.images[0].points.mean(axis=0)
        paper = _PAPER * float(np.sqrt(np.square(apart).sum(axis=1).mean()))
        config = replace(config, map_deviation=paper)
    config = replace(config, readout_time_deviation=shutter.deviation)
    camera = replace(lens, readout_time=shutter.readout_time, scan_direction=shutter.scan_direction)
    whole = list(clip.images)
    poses: dict[str, Poses] = {}
    for name in (*METHODS, *PEERS):
        begin = time.process_time()
        poses[name] = localized(name, camera, whole, config)
        row[f"{name}_localized"] = sum(map(bool, poses[name]))
        row[f"{name}_ms"] = 1e3 * (time.process_time() - begin) / len(whole)
        reasons = [str(one.reason) for one in poses[name] if isinstance(one, Failure)]
        row |= {f"{name}_{reason}": count for reason, count in Counter(reasons).items()}
    for name in (*METHODS, *(peer for peer in PEERS if peer != PEER)):
        of_name = jitter(clip, poses[name], poses[PEER])
        row |= {f"{name}_{key}": x for key, x in of_name.items()}
    for name in METHODS[1:]:
        of_name = _twists(clip, poses[name], poses[PEER], shutter.readout_time)
        row |= {f"{name}_{key}": x for key, x in of_name.items()}
    row |= _halves(camera, whole, config)
    return row


def localized(
    name: str, camera: Camera, images: Sequence[ImagePoints], config: NodeConfig
) -> Poses:
    """Each image, by one of the methods.

    default: as a node without any parameter; single: with the readout time, each image alone;
    tracked: with it, one after the other. Or by one of the peers.
    """
    if name == "default":
        camera, name = replace(camera, readout_time=0.0), "single"
    if name == "tracked":
        tracker = Tracker(Localizer(camera, config))
        known = FrameContext(readout_time_deviation=config.readout_time_deviation)
        return [
            tracker.localize(image.stamp_ns, image.points, image.pixels, context=known)
            for image in images
        ]
    if name in PEERS:
        return [PEERS[name](camera, image.points, image.pixels) for image in images]
    localizer = Localizer(camera, config)
    return [localizer.localize(image.points, image.pixels) for image in images]


def jitter(clip: Clip, poses: Poses, others: Poses) -> dict[str, float]:
    """Second differences of orientation over those of another method, on images both localize."""
    pairs = []
    stamps = np.array([image.stamp_ns for image in clip.images]) * 1e-9
    for k in range(1, len(poses) - 1):
        triples = [[one for one in of[k - 1 : k + 2] if one] for of in (poses, others)]
        if any(len(triple) < 3 for triple in triples) or (
            stamps[k + 1] - stamps[k - 1] > 3.0 * clip.interval
        ):
            continue
        pairs.append([_second_difference(triple) for triple in triples])
    found: dict[str, float] = {}
    for part in (50, 95):
        own, other = np.percentile(pairs or np.full((1, 2), np.nan), part, axis=0)
        found[f"turn{part}"] = float(own / other)
    return found


def _second_difference(triple: Sequence[Pose]) -> float:
    """rad."""
    a, b, c = (one.rotation for one in triple)
    return float(np.linalg.norm(so3.log(c @ b.T) - so3.log(b @ a.T)))


def _twists(clip: Clip, poses: Poses, peer: Poses, readout_time: float) -> dict[str, float]:
    """Turn rates against a peer's poses of the neighbours, and the share inside 95 % regions."""
    inside = []
    for k in range(1, len(poses) - 1):
        before, here, after = peer[k - 1], poses[k], peer[k + 1]
        seconds = 1e-9 * (clip.images[k + 1].stamp_ns - clip.images[k - 1].stamp_ns)
        if not (before and here and after and seconds < 3.0 * clip.interval):
            continue
        assert isinstance(here, Estimate)
        assert isinstance(before, GlobalPose)
        assert isinstance(after, GlobalPose)
        rate = so3.log(before.rotation @ after.rotation.T) / seconds
        error = here.angular_velocity / readout_time - rate
        of_rate = (before.turn_covariance + after.turn_covariance) / seconds**2
        spread = here.covariance[ANGULAR, ANGULAR] / readout_time**2 + of_rate
        inside.append(error @ np.linalg.solve(spread, error) < _INSIDE_3)
    return {"twist_inside": float(np.mean(inside))} if inside else {}


def _halves(camera: Camera, images: Sequence[ImagePoints], config: NodeConfig) -> dict[str, float]:
    """Poses of one half of the corners against those of the other, and what each says of the
    other's corners: rolling over global shutter.

    Poses are of the two sides of the board: random halves share its bend. Corners are held out by
    random halves.
    """
    row: dict[str, float] = {}
    for name in ("single", "tracked"):
        sides = [localized(name, camera, part, config) for part in _parts(images, _sides)]
        row |= {f"{name}_{key}": x for key, x in _agreement(*sides).items()}
    parts = _parts(images, lambda image, seed: halved(len(image.points), seed))
    errors = {
        name: _errors(camera, localized(name, camera, parts[0], config), parts[1])
        for name in ("single", "tracked", PEER)
    }
    for name in ("single", "tracked"):
        row[f"{name}_held"] = _ratio(errors[name], errors[PEER])
    return row


def _sides(image: ImagePoints, number: int) -> tuple[IntArray, IntArray]:
    """Left and right, or upper and lower half of the board in turn."""
    order = np.argsort(image.points[:, number % 2], kind="stable")
    return order[: len(order) // 2], order[len(order) // 2 :]


def _parts(
    images: Sequence[ImagePoints], split: Callable[[ImagePoints, int], tuple[IntArray, IntArray]]
) -> list[list[ImagePoints]]:
    """The images with one part of their corners, and with the other."""
    parts: list[list[ImagePoints]] = [[], []]
    for number, image in enumerate(images):
        for part, chosen in zip(parts, split(image, number), strict=True):
            part.append(replace(image, points=image.points[chosen], pixels=image.pixels[chosen]))
    return parts


def _agreement(ones: Poses, others: Poses) -> dict[str, float]:
    """How two poses of each image agree, and whether their covariances say so.

    Poses are compared at the same motion: what the prior says of the velocities is the same
    in both, and would be a part of both regions and of no difference.
    """
    inside, turns = [], []
    for one, other in zip(ones, others, strict=True):
        if not (isinstance(one, Estimate) and isinstance(other, Estimate)):
            continue
        move = one.rotation @ (other.position - one.position)
        step = np.concatenate([so3.log(one.rotation @ other.rotation.T), move])
        first, _ = _at_known_motion(one)
        second, gain = _at_known_motion(other)
        step = step + gain @ (_motion(one) - _motion(other))
        spread = first + second
        inside.append(step @ np.linalg.solve(spread, step) < _INSIDE)
        turns.append(step[:3] @ np.linalg.solve(spread[:3, :3], step[:3]))
    if not inside:
        return {"halves": 0}
    claimed = math.sqrt(_MEDIAN / np.median(turns))
    return {"halves": len(inside), "inside": float(np.mean(inside)), "turn_claimed": claimed}


def _motion(estimate: Estimate) -> Array:
    """Velocities (6,)."""
    return np.concatenate([estimate.angular_velocity, estimate.linear_velocity])


def _at_known_motion(estimate: Estimate) -> tuple[Array, Array]:
    """Covariance (6,6) of the pose at given velocities, and how it follows them (6,6)."""
    covariance = estimate.covariance
    gain = covariance[POSE, VELOCITIES] @ np.linalg.inv(covariance[VELOCITIES, VELOCITIES])
    return covariance[POSE, POSE] - gain @ covariance[VELOCITIES, POSE], gain


def _errors(camera: Camera, poses: Poses, held_out: Sequence[ImagePoints]) -> Array:
    """Mean squared errors (f,) of corners that no pose has seen, px^2; NaN without a pose."""
    errors = np.full(len(poses), np.nan)
    for k, (pose, image) in enumerate(zip(poses, held_out, strict=True)):
        if pose:
            pixels = project_rolling(camera, pose.at_rows, image.points)[0]
            errors[k] = np.mean(np.sum((pixels - image.pixels) ** 2, axis=1))
    return errors


def _ratio(errors: Array, others: Array) -> float:
    """Of the root mean squares on common images."""
    common = np.isfinite(errors) & np.isfinite(others)
    if not common.any():
        return math.nan
    return float(np.sqrt(errors[common].sum() / others[common].sum()))
