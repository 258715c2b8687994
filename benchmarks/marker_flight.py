# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How well markers were detected and frames localized along a rendered flight, by its truth:

    rs_localizer simulate flight --images --trajectory tum_vi_room5 --exposure 0.005 --grey-noise 2
    rs_localizer detect flight --map flight/marker_map.yaml --out markers
    for solver in r6p_vcwt p3p; do
        rs_localizer replay markers --params markers/parameters.yaml -p pose_time:=mid_frame \
            -p solver:=$solver --out poses_$solver
    done
    python -m benchmarks.marker_flight flight markers poses_r6p_vcwt poses_p3p
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.recording import (
    CAMERA_INFO_TOPIC,
    CORRESPONDENCES_TOPIC,
    MARKER_MAP,
    PARAMETERS,
    RAW_IMAGE_TOPIC,
)
from rs_localizer.io.trajectories import Motions, read_motions
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.settings import build, load_params_file
from rs_localizer.simulation.frames import middle_stamp
from rs_localizer.simulation.marker_frames import visible
from rs_localizer.simulation.recording import TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC

_LEAST_MARKERS = 3
_FAST = 60.0  # deg/s


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """A rendered recording: the frames that show so many markers that they can be localized."""

    camera: Camera
    middles_ns: list[int]
    true_motions: list[Motion]
    speeds: Array  # (frames,) deg/s
    corners: list[tuple[Array, Array]]  # detected: points (n,3) and raw pixels (n,2)
    frames: int  # in all


@dataclass(frozen=True, slots=True)
class Quality:
    """Of the frames of a flight."""

    localized: float  # share
    position: float  # m, median; a frame without a pose counts as infinitely wrong
    position_fast: float  # m, where the camera turns faster than 60 deg/s
    reprojection: float  # px, median of all detected corners of the localized frames


def load_flight(images: Path, detected: Path) -> Flight:
    """Read what ``simulate --images`` and ``detect`` wrote."""
    shutter = build(load_params_file(images / PARAMETERS))
    clouds = {}
    with open_bag(detected) as bag:
        for _, _, message in bag.messages([CORRESPONDENCES_TOPIC]):
            cloud = read_correspondences(message)
            clouds[cloud.stamp_ns] = (cloud.points, cloud.pixels)
    with open_bag(images) as bag:
        stamps = [stamp for _, stamp, _ in bag.messages([RAW_IMAGE_TOPIC])]
        info = next(message for _, _, message in bag.messages([CAMERA_INFO_TOPIC]))
    camera = read_camera_info(info).camera(shutter.readout_time, shutter.scan_direction)
    truth = _motions(read_motions(images, TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC), camera)
    corners = read_marker_map(images / MARKER_MAP).points
    middles, motions, found = [], [], []
    for stamp in stamps:
        middle = middle_stamp(camera, stamp)
        quads = project_rolling(camera, truth[middle].at_rows, corners)[0].reshape(-1, 4, 2)
        if np.count_nonzero(visible(quads, camera.size)) >= _LEAST_MARKERS:
            middles.append(middle)
            motions.append(truth[middle])
            found.append(clouds.get(stamp, (np.zeros((0, 3)), np.zeros((0, 2)))))
    rates = np.array([np.linalg.norm(motion.angular_velocity) for motion in motions])
    speeds = np.degrees(rates) / camera.readout_time
    return Flight(camera, middles, motions, speeds, found, len(stamps))


def quality(flight: Flight, poses: Path) -> Quality:
    """Of poses for the middle rows, as ``replay -p pose_time:=mid_frame`` writes them."""
    estimates = _motions(read_motions(poses), flight.camera)
    errors, residuals = [], []
    for middle, true, (points, pixels) in zip(
        flight.middles_ns, flight.true_motions, flight.corners, strict=True
    ):
        found = estimates.get(middle)
        if found is None:
            errors.append(np.inf)
            continue
        errors.append(float(np.linalg.norm(_position(found) - _position(true))))
        if len(points):
            predicted = project_rolling(flight.camera, found.at_rows, points)[0]
            residuals.append(np.linalg.norm(predicted - pixels, axis=1))
    positions = np.array(errors)
    return Quality(
        localized=float(np.mean(np.isfinite(positions))),
        position=float(np.median(positions)),
        position_fast=float(np.median(positions[flight.speeds > _FAST])),
        reprojection=float(np.nanmedian(np.concatenate(residuals))),
    )


def _motions(read: Motions, camera: Camera) -> Mapping[int, Motion]:
    """By time; still where there are no twists."""
    twists: dict[int, tuple[Array, Array]] = {}
    if read.twists is not None:
        twists = {
            int(stamp): (angular, linear)
            for stamp, angular, linear in zip(
                read.twists.stamps_ns, read.twists.angular, read.twists.linear, strict=True
            )
        }
    rotations = np.swapaxes(Rotation.from_quat(read.poses.quaternions).as_matrix(), 1, 2)
    still = (np.zeros(3), np.zeros(3))
    motions = {}
    for stamp, rotation, position in zip(
        read.poses.stamps_ns.tolist(), rotations, read.poses.positions, strict=True
    ):
        angular, linear = (camera.readout_time * v for v in twists.get(stamp, still))
        motions[stamp] = Motion(rotation, -rotation @ position, angular, linear)
    return motions


def _position(motion: Motion) -> Array:
    position: Array = -motion.rotation.T @ motion.translation
    return position


def main(arguments: list[str] | None = None, out: TextIO = sys.stdout) -> None:
    """Print the quality of several estimates."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.marker_flight",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("images", type=Path, help="directory that simulate --images wrote")
    parser.add_argument("markers", type=Path, help="bag that detect wrote")
    parser.add_argument("poses", type=Path, nargs="+", help="directories that replay wrote")
    options = parser.parse_args(arguments)
    flight = load_flight(options.images, options.markers)
    fast = np.count_nonzero(flight.speeds > _FAST)
    out.write(
        f"{flight.frames} frames; {len(flight.middles_ns)} show {_LEAST_MARKERS} markers or more, "
        f"{fast} of them faster than {_FAST:g} deg/s\n"
        f"{'':24}{'localized':>12}{'position':>12}{'where fast':>12}{'reprojection':>14}\n"
    )
    for poses in options.poses:
        found = quality(flight, poses)
        out.write(
            f"{poses.name:24}{100 * found.localized:10.1f} %{1e3 * found.position:9.1f} mm"
            f"{1e3 * found.position_fast:9.1f} mm{found.reprojection:11.3f} px\n"
        )


if __name__ == "__main__":
    main()
