# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Folders as other programs write them, rendered: their truth is known, and no line is shared with
what reads them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent import motions
from benchmarks.independent.cameras import Camera
from benchmarks.independent.rendering import TEXEL, Room, filmed

PERIOD = 1.0 / 30.0
SIZE, SQUARE = 3.6, 4 * TEXEL  # m, of a room, and of a board's squares
SINCE_BOOT = 43210.5  # s
# The camera in the phone's or the board's axes: whoever reads the gyroscope has to find it.
CAMERA_FROM_GYROSCOPE = Rotation.from_euler("zx", [90.0, 180.0], degrees=True)
BIAS = np.array([0.01, -0.02, 0.015])  # rad/s


@dataclass(frozen=True, eq=False)
class Film:
    """Images of one clip and what was true."""

    camera: Camera
    motion: motions.Motions
    seconds: np.ndarray  # (f,) of the first rows
    images: list[np.ndarray]
    depths: list[np.ndarray]  # m

    def rates(self, seconds: np.ndarray) -> np.ndarray:
        """Turn rates (n,3), rad/s in camera axes."""
        return self.motion.states(np.zeros(len(seconds), int), seconds).angular

    def poses(self, seconds: np.ndarray) -> tuple[Rotation, np.ndarray]:
        """map_from_camera."""
        rotations, places = self.motion.poses(np.zeros(len(seconds), int), seconds)
        return Rotation.from_matrix(rotations), places

    def readings(self, seconds: np.ndarray) -> np.ndarray:
        """What the gyroscope beside the camera reads (n,3)."""
        return CAMERA_FROM_GYROSCOPE.inv().apply(self.rates(seconds)) + BIAS


def in_hand(forward: Sequence[float], seed: int, slower: float) -> motions.Motions:
    """A hand's motion about the middle of the room while the camera looks forward."""
    moving = motions.hand(1, np.random.default_rng(seed), slower)
    z = np.array(forward) / np.linalg.norm(forward)
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    looking = np.column_stack([x, np.cross(z, x), z])
    return replace(moving, rotation=looking[None], position=np.zeros((1, 3)))


def papered() -> Room:
    return Room.papered(SIZE, np.random.default_rng(0))


def with_board(columns: int, lines: int) -> Room:
    """A room whose wall at +z has a chessboard of so many inner corners, with squares of SQUARE."""
    room, wide = papered(), round(SQUARE / TEXEL)
    wall = room.papers[5]
    wall[:] = 215.0
    left = (np.array(wall.shape) - wide * np.array([columns + 1, lines + 1])) // 2
    for i in range(columns + 1):
        for j in range(lines + 1):
            if (i + j) % 2 == 0:
                u, v = left + wide * np.array([i, j])
                wall[u : u + wide, v : v + wide] = 40.0
    return room


def film(
    count: int, camera: Camera, room: Room, motion: motions.Motions, period: float = PERIOD,
    samples: int = 2,
) -> Film:  # fmt: skip
    """A clip of a room."""
    seconds = period * np.arange(count)
    shots = [filmed(camera, motion, room, time, samples) for time in seconds]
    return Film(camera, motion, seconds, [image for image, _ in shots], [d for _, d in shots])


def write_csv(
    path: Path, heading: str, rows: Sequence[Sequence[object]], between: str = ","
) -> None:
    lines = [heading, *(between.join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def write_stray(folder: Path, clip: Film, late: int = 1) -> None:
    """As Stray Scanner does: the video's first image has the stamp of row ``late``."""
    folder.mkdir()
    height, width = clip.images[0].shape
    codec = cv2.VideoWriter_fourcc(*"mp4v")
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), codec, 30.0, (width, height))
    for image in clip.images:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    np.savetxt(folder / "camera_matrix.csv", clip.camera.matrix, delimiter=", ", fmt="%.6f")
    seconds = PERIOD * (np.arange(len(clip.images) + late) - late)
    turns, places = clip.poses(seconds + 0.5 * clip.camera.readout_time)
    rows = [
        (f"{SINCE_BOOT + t:.6f}", f"{k:06d}", *np.round(p, 6), *np.round(q, 7))
        for k, (t, p, q) in enumerate(zip(seconds, places, turns.as_quat(), strict=True))
    ]
    heading = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    write_csv(folder / "odometry.csv", heading, rows, ", ")
    times = np.arange(-0.2, seconds[-1] + 0.3, 0.01)
    readings = clip.readings(times)
    rows = [
        (f"{SINCE_BOOT + t:.6f}", 0.0, -1.0, 0.0, *np.round(w, 7))
        for t, w in zip(times, readings, strict=True)
    ]
    heading = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"
    write_csv(folder / "imu.csv", heading, rows, ", ")
    for name in ("depth", "confidence"):
        (folder / name).mkdir()
    size = (width // 4, height // 4)
    for k in range(late, len(seconds)):
        metres = cv2.resize(clip.depths[k - late], size, interpolation=cv2.INTER_AREA)
        noisy = metres + 0.005 * np.random.default_rng(k).normal(size=metres.shape)
        sure = np.full(metres.shape, 2, np.uint8)
        sure[:, : size[0] // 8] = 0  # and wrong there
        noisy[sure == 0] = 0.4
        cv2.imwrite(str(folder / "depth" / f"{k:06d}.png"), (1e3 * noisy).astype(np.uint16))
        cv2.imwrite(str(folder / "confidence" / f"{k:06d}.png"), sure)


def write_oak(folder: Path, clip: Film, late: int = 0, exposure: float = 0.003) -> None:
    """As the recorder of rolling-shutter-as-an-imu does; stamps are the end of the exposure.

    With ``late`` each image has the stamp of another one.
    """
    (folder / "rgb").mkdir(parents=True)
    rows = []
    for k, (time, image) in enumerate(zip(clip.seconds, clip.images, strict=True)):
        # An exposure of another length ends at another time after its middle.
        long = exposure * (1.0 + k % 2)
        stamp = round(1e9 * (SINCE_BOOT + time + PERIOD * late + 0.5 * long))
        name = f"rgb/rgb_{stamp}_{k}.png"
        cv2.imwrite(str(folder / name), image)
        rows.append((stamp, "rgb", k, round(1e6 * long), 800, name))
    write_csv(folder / "frames.csv", "timestamp_ns,type,seq,exposure_us,iso,path", rows)
    times = np.arange(-0.2, clip.seconds[-1] + 0.3, 0.0025)
    readings = [
        (round(1e9 * (SINCE_BOOT + t)), *w, 0.0, 0.0, 0.0)
        for t, w in zip(times, clip.readings(times), strict=True)
    ]
    readings[7] = (readings[7][0], "", "", "", 0.0, 0.0, 0.0)  # a packet without a gyroscope
    rates = ",".join(f"gyro_{axis}_rad_s" for axis in "xyz")
    forces = ",".join(f"linacc_{axis}_m_s2" for axis in "xyz")
    heading = f"timestamp_ns,{rates},{forces}"
    write_csv(folder / "imu.csv", heading, readings)


def write_lens(path: Path, camera: Camera) -> Path:
    """A file of the lens as ROS' camera calibration writes it."""
    matrix = ", ".join(f"{value:.6f}" for value in camera.matrix.ravel())
    path.write_text(
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: oak\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: [{matrix}]}}\n"
        "distortion_model: plumb_bob\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: {list(camera.distortion)}}}\n"
    )
    return path


@dataclass(frozen=True, eq=False)
class Mounted:
    """The motion of a camera on a body that moves."""

    body: motions.Motions
    rotation: np.ndarray  # (3,3) body_from_camera
    place: np.ndarray  # (3,) of the camera on the body

    def poses(self, which: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rotations, places = self.body.poses(which, time)
        return rotations @ self.rotation, places + rotations @ self.place


def write_tum_rs(folder: Path, body: motions.Motions, films: dict[str, Film]) -> None:
    """As the TUM rolling-shutter dataset has it: EuRoC's layout, body poses, Kalibr's camchain."""
    since = 1_536_000_000.0  # s
    chain = []
    for name, clip in films.items():
        (folder / "mav0" / name / "data").mkdir(parents=True)
        rows = []
        for time, image in zip(clip.seconds, clip.images, strict=True):
            stamp = round(1e9 * since) + round(1e9 * time)
            cv2.imwrite(str(folder / "mav0" / name / "data" / f"{stamp}.png"), image)
            rows.append((stamp, f"{stamp}.png"))
        write_csv(folder / "mav0" / name / "data.csv", "#timestamp [ns],filename", rows)
        camera, mount = clip.camera, np.eye(4)
        mount[:3, :3] = clip.motion.rotation.T
        mount[:3, 3] = -clip.motion.rotation.T @ clip.motion.place
        u, v = camera.centre
        chain += [
            f"{name}:", "  T_cam_imu:", *(f"  - {row.tolist()}" for row in mount),
            "  camera_model: pinhole", "  distortion_model: radtan",
            f"  distortion_coeffs: {list(camera.distortion[:4])}",
            f"  intrinsics: [{camera.focal}, {camera.focal}, {u}, {v}]",
            f"  resolution: [{camera.width}, {camera.height}]",
        ]  # fmt: skip
    (folder / "dso").mkdir()
    (folder / "dso" / "camchain.yaml").write_text("\n".join(chain) + "\n")
    last = max(clip.seconds[-1] for clip in films.values())
    seconds = np.arange(-0.3, last + 0.4, 1.0 / 120.0)
    rotations, places = body.poses(np.zeros(len(seconds), int), seconds)
    rng = np.random.default_rng(1)
    places = places + 1e-4 * rng.normal(size=places.shape)
    noise = Rotation.from_rotvec(3e-4 * rng.normal(size=places.shape))
    quaternions = (Rotation.from_matrix(rotations) * noise).as_quat()
    rows = [
        (round(1e9 * since) + round(1e9 * t), *p, q[3], *q[:3])
        for t, p, q in zip(seconds, places, quaternions, strict=True)
    ]
    (folder / "mav0" / "mocap0").mkdir()
    heading = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]," + ",".join(
        f"q_RS_{axis} []" for axis in "wxyz"
    )
    write_csv(folder / "mav0" / "mocap0" / "data.csv", heading, rows)
