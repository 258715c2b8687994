# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks real tum-rs FOLDER``: a real rolling shutter before motion capture.

FOLDER is a sequence of the TUM rolling-shutter dataset (Schubert, Demmel, von Stumberg, Usenko,
Cremers, IROS 2019): ``mav0/cam0`` of a global shutter, ``mav0/cam1`` of a rolling one beside it,
``mav0/mocap0/data.csv`` with poses of the IMU, and Kalibr's camchain, in ``dso/`` or of another
place. The map is that of the global camera, triangulated with the motion capture; poses and
velocities are those of the rolling one.

    python -m benchmarks real tum-rs dataset-seq1 --camchain camchain.yaml \\
        -p readout_time:=0.03015 --seconds 30
    python -m benchmarks real mocap BAG --truth poses.txt -p readout_time:=0.02

The second line is for motion capture of your own: a bag with ``camera_info`` and correspondences,
and the camera's poses in the frame of the points (TUM: ``t x y z qx qy qz qw``, optical axes).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from benchmarks.real.gyroscopes import best_offset, in_images
from benchmarks.real.motion import EPOCH_NS, Motion, judge, table
from benchmarks.real.recordings import Frame, Recording, add_settings, read_bag
from rs_localizer.cli.settings_args import given_settings
from rs_localizer.config import FeatureConfig, FeatureKind, Matching, NodeConfig
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.features.extraction import FeatureExtractor, Features
from rs_localizer.io.camera_files import read_calibration
from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.trajectories import Trajectory, read_tum, split_at_gaps
from rs_localizer.localizer import Localizer
from rs_localizer.matching import Matcher
from rs_localizer.pipeline.pose_at_time import middle_row_ns
from rs_localizer.tools.mapping.triangulation import Sights, triangulate
from rs_localizer.tracking import Tracker

# Keyframes of the map: so far apart, s, each matched with the next.
_KEYFRAMES = 0.2
_RATIO = 0.8  # of the distances of the best and the second descriptor
_LEAST_VIEWS, _MOST_SPREAD = 3, 0.03  # of a landmark; of its distance: as of ``map build``
# Motion capture at 120 Hz is smoothed by cubics over 0.09 s: its noise of a tenth of a millimetre
# would be centimetres a second.
_SMOOTHED, _CUBIC = 11, 3
_MARGIN = 0.1  # s, at the ends of a part without gaps
_MOCAP, _CAMCHAIN = "mav0/mocap0/data.csv", "dso/camchain.yaml"


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """A camera on the body whose poses the motion capture gives."""

    lens: Camera
    rotation: Array  # (3,3) camera_from_body
    translation: Array  # (3,)
    stamps_ns: IntArray
    files: Sequence[Path]

    def motion(self, body: Motion) -> tuple[Array, Array]:
        """Rotations map_from_camera and positions at its stamps."""
        return self.poses(body, _seconds(self.stamps_ns))

    def poses(self, body: Motion, times: Array) -> tuple[Array, Array]:
        """Likewise at times (n,), s."""
        rotations, places = body.poses(times)
        return rotations @ self.rotation.T, places - (
            rotations @ (self.rotation.T @ self.translation)
        )


def smoothed(path: Path) -> Motion:
    """The longest part without gaps of motion capture."""
    read = _read_euroc if path.suffix == ".csv" else read_tum
    part: Trajectory = max(split_at_gaps(read(path)), key=len)
    if len(part) <= _SMOOTHED:
        raise ValueError(f"{path} has no part of more than {_SMOOTHED} poses without a gap")
    quaternions = part.quaternions.copy()
    signs = np.sign(np.sum(quaternions[1:] * quaternions[:-1], axis=1))
    quaternions[1:] *= np.cumprod(np.where(signs == 0.0, 1.0, signs))[:, None]
    values = np.column_stack([quaternions, part.positions])
    smooth = savgol_filter(values, _SMOOTHED, _CUBIC, axis=0)
    return Motion.of(_seconds(part.stamps_ns), Rotation.from_quat(smooth[:, :4]), smooth[:, 4:])


def _read_euroc(path: Path) -> Trajectory:
    """Poses in EuRoC's order: ns, position, quaternion w x y z."""
    rows = [line.split(",")[:8] for line in path.read_text().splitlines() if line[:1].isdigit()]
    values = np.array([row[1:] for row in rows], np.float64)
    stamps_ns, known = np.array([int(row[0]) for row in rows]), np.isfinite(values).all(axis=1)
    found = Trajectory(stamps_ns, values[:, :3], np.roll(values[:, 3:], -1, axis=1))
    return found.part(np.asarray(known, np.bool_))


def _seconds(stamps_ns: IntArray) -> Array:
    return np.asarray(1e-9 * (stamps_ns - EPOCH_NS), np.float64)


def read_camera(folder: Path, name: str, chain: Path) -> Mounted:
    """One camera of a sequence; raises ``ValueError`` where files lack something."""
    tree = yaml.safe_load(chain.read_text(encoding="utf-8"))
    if "T_cam_imu" not in tree.get(name, {}):
        raise ValueError(f"{chain} lacks T_cam_imu of {name}: it has {sorted(tree.get(name, {}))}")
    mount = np.array(tree[name]["T_cam_imu"], float)
    listing = folder / "mav0" / name / "data.csv"
    lines = [line.split(",") for line in listing.read_text().splitlines() if line[:1].isdigit()]
    files = [listing.parent / "data" / row[1].strip() for row in lines]
    stamps = np.array([int(row[0]) for row in lines], np.int64)
    lens = read_calibration(f"{chain}#{name}")
    return Mounted(lens, mount[:3, :3], mount[:3, 3], stamps, files)


def map_of(camera: Mounted, body: Motion) -> Map:
    """Landmarks of a global-shutter camera on a known motion.

    Raises:
        ValueError: when no landmark is seen well enough.
    """
    extractor = FeatureExtractor(FeatureKind.SIFT, FeatureConfig().max_keypoints)
    rotations, positions = camera.motion(body)
    ids, fresh, before = np.zeros(0, np.int64), 0, None
    sights, descriptors = [], []
    for k in _keyframes(camera.stamps_ns):
        features = extractor.extract(_read(camera.files[k]))
        new = np.full(len(features), -1)
        if before is not None:
            one, other = _matched(before, features)
            new[other] = ids[one]
        unseen = np.flatnonzero(new < 0)
        new[unseen] = fresh + np.arange(len(unseen))
        fresh += len(unseen)
        descriptors.append(features.descriptors[unseen])
        sights.append((np.full(len(new), k), new, features.pixels))
        ids, before = new, features
    images, points, pixels = (np.concatenate(part) for part in zip(*sights, strict=True))
    seen = Sights(rotations[images], positions[images], pixels.astype(float), points)
    found = triangulate(camera.lens, seen, fresh)
    away = np.linalg.norm(found.points - positions.mean(axis=0), axis=1)
    good = (found.counts >= _LEAST_VIEWS) & (found.spread < _MOST_SPREAD * away)
    if not good.any():
        raise ValueError(f"none of {fresh} features of the global camera makes a landmark")
    return Map(found.points[good], None, np.concatenate(descriptors)[good], "map")


def _keyframes(stamps_ns: IntArray) -> list[int]:
    chosen = [0]
    for k, stamp in enumerate(stamps_ns.tolist()):
        if stamp - stamps_ns[chosen[-1]] >= 1e9 * _KEYFRAMES:
            chosen.append(k)
    return chosen


def _matched(one: Features, other: Features) -> tuple[IntArray, IntArray]:
    """Rows of features that are each other's nearest by far."""
    left, right = (np.asarray(x.descriptors, np.float32) for x in (one, other))
    pairs = cv2.BFMatcher().knnMatch(left, right, k=2)
    back = {match[0].queryIdx: match[0].trainIdx
            for match in cv2.BFMatcher().knnMatch(right, left, k=1) if match}  # fmt: skip
    kept = [
        (best.queryIdx, best.trainIdx)
        for best, second in (pair for pair in pairs if len(pair) == 2)
        if best.distance < _RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    rows = np.array(kept, np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _read(file: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{file} is no image")
    return np.asarray(image, np.uint8)


def read_sequence(
    folder: Path, chain: Path, config: NodeConfig, start: float = 0.0, seconds: float = math.inf
) -> tuple[Recording, Motion]:
    """The rolling camera's recording, and its true motion.

    Args:
        chain: Kalibr's file of both cameras.
        config: of which the readout time, scan direction and stamp offset are used.
        start, seconds: s, the part of it.

    Raises:
        ValueError: for another folder, or without a readout time.
    """
    if not config.readout_time > 0.0:
        raise ValueError("velocities need the readout time: -p readout_time:=0.03015")
    for file in (chain, folder / _MOCAP):
        if not file.is_file():
            raise ValueError(f"{file} is missing")
    body = smoothed(folder / _MOCAP)
    first = max(body.start, body.start + start) + _MARGIN
    last = min(body.end, first + seconds) - _MARGIN
    cameras = [_within(read_camera(folder, name, chain), first, last) for name in ("cam0", "cam1")]
    still, rolling = cameras
    if not len(still.stamps_ns) or not len(rolling.stamps_ns):
        raise ValueError(f"{folder}: no images between {first:.1f} and {last:.1f} s")
    matcher = Matcher(map_of(still, body))
    camera = replace(
        rolling.lens, readout_time=config.readout_time, scan_direction=config.scan_direction
    )
    extractor = FeatureExtractor(FeatureKind.SIFT, FeatureConfig().max_keypoints)
    frames = []
    for stamp, file in zip(rolling.stamps_ns.tolist(), rolling.files, strict=True):
        found = extractor.extract(_read(file))
        keypoints = Keypoints(stamp, found.pixels, None, found.descriptors, found.scores, 0)
        matches = matcher.match(keypoints, Matching())
        frames.append(
            Frame(
                middle_row_ns(config, camera, stamp), matcher.map.points[matches.landmarks],
                np.asarray(found.pixels[matches.keypoints], float),
            )
        )  # fmt: skip
    times = np.arange(body.start, body.end, 0.005)
    turns, places = rolling.poses(body, times)
    return Recording(folder.name, camera, frames), Motion.of(
        times, Rotation.from_matrix(turns), places
    )


def _within(camera: Mounted, first: float, last: float) -> Mounted:
    times = _seconds(camera.stamps_ns)
    rows = np.flatnonzero((times >= first) & (times <= last))
    files = [camera.files[k] for k in rows.tolist()]
    return replace(camera, stamps_ns=camera.stamps_ns[rows], files=files)


def agreement(recording: Recording, motion: Motion) -> str:
    """A line: at which offset of the clocks tracked twists are most like the truth."""
    tracker = Tracker(Localizer(recording.camera), output_lag=1)
    found = [
        tracker.localize(frame.middle_ns, frame.points, frame.pixels) for frame in recording.frames
    ]
    estimates = [one for one in (*found, *tracker.flush()) if one]
    times = np.array([1e-9 * (one.time_ns - EPOCH_NS) for one in estimates])
    rates = np.array([one.angular_velocity for one in estimates]) / recording.camera.readout_time
    offset, likeness = best_offset(rates, lambda later: motion.turns(times - later, 1))
    return f"twists are most like the truth at {in_images(offset, times)}: {likeness:.3f}"


def main(argv: Sequence[str]) -> None:
    """The command ``tum-rs``."""
    parser = _parser("tum-rs")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--camchain", type=Path, help=f"Kalibr's (default: {_CAMCHAIN})")
    parser.add_argument("--start", type=float, default=0.0, help="s after the motion capture's")
    parser.add_argument("--seconds", type=float, default=math.inf, help="of it, at most")
    args = parser.parse_args(argv)
    chain, config = args.camchain or args.folder / _CAMCHAIN, given_settings(args)
    _print(*read_sequence(args.folder, chain, config, args.start, args.seconds))


def mocap(argv: Sequence[str]) -> None:
    """The command ``mocap``."""
    parser = _parser("mocap")
    parser.add_argument("recording", type=Path, help="a bag")
    parser.add_argument("--truth", type=Path, required=True, help="poses of the camera: TUM")
    args = parser.parse_args(argv)
    recording = read_bag(args.recording, given_settings(args))
    truth = smoothed(args.truth)
    times = [1e-9 * (frame.middle_ns - EPOCH_NS) for frame in recording.frames]
    frames = [
        frame
        for frame, time in zip(recording.frames, times, strict=True)
        if truth.start + _MARGIN <= time <= truth.end - _MARGIN
    ]
    if not frames:
        raise ValueError(f"{args.truth} has no poses while the images were taken")
    _print(replace(recording, frames=frames), truth)


def _parser(name: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks real {name}", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    add_settings(parser)
    return parser


def _print(recording: Recording, truth: Motion) -> None:
    points = int(np.median([len(frame.points) for frame in recording.frames]))
    print(table(judge(recording, truth)).text())
    print(f"{len(recording.frames)} images, {points} points each (median)")
    print(agreement(recording, truth))
