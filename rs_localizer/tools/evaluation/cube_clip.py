# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Walls of markers along a recorded hand, rendered and detected, and an animation of a cube there.

The cube is drawn by the poses of P3P and by those of the localizer.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image as Pillow

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.io.video import Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.simulation.frames import frame_stamps, middle_stamp, true_poses_at
from rs_localizer.tools.simulation.renderer import Renderer, in_order
from rs_localizer.tools.simulation.settings import ImageSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, TrueMotion, sampled_states
from rs_localizer.tools.simulation.walls import three_walls

CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
RATE = 30.0
SENSOR = ImageSettings(exposure=0.005, noise=2.0)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFrame:
    """What is detected in one image."""

    stamp_ns: int
    middle_ns: int
    points: Array  # (n,3) m, corners of the detected markers
    pixels: Array  # (n,2) raw


class MarkerWalls:
    """Three walls around a recorded motion, and the camera before them."""

    def __init__(self, trajectory: Trajectory, seed: int, sensor: ImageSettings = SENSOR) -> None:
        self.motion = RecordedMotion(trajectory)
        scene = three_walls(sampled_states(self.motion))
        assert scene.marker_map is not None
        self.markers: Sequence[Marker] = scene.marker_map.markers
        self._renderer = Renderer(CAMERA, scene.planes, sensor)
        self._detector = MarkerDetector(scene.marker_map)
        self._seed = seed

    def stamps(self) -> list[int]:
        """Of all frames within the motion."""
        return frame_stamps(self.motion, CAMERA, RATE)

    def frames(self, stamps_ns: Sequence[int]) -> Iterator[tuple[MarkerFrame, Image]]:
        """The frames with these stamps, and their images (height, width)."""

        def frame(stamp_ns: int) -> tuple[MarkerFrame, Image]:
            image = self._renderer.image(self.motion, stamp_ns, (self._seed, stamp_ns))
            found = self._detector.detect(image)
            middle_ns = middle_stamp(CAMERA, stamp_ns)
            return MarkerFrame(stamp_ns, middle_ns, found.points, found.pixels), image

        return in_order(frame, stamps_ns)


_BAR, _GAP = 30, 6  # px
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.55
_PALETTE = 64


def side_by_side(
    pictures: Sequence[Image],
    captions: Sequence[Sequence[str]],
    colors: Sequence[tuple[int, int, int]],
    width: int,
) -> Image:
    """Pictures (h,w,3) in a row, each ``width`` px wide below a bar with two words on it.

    The first stands on the left of the bar, the second on the right.
    """
    height = round(width * pictures[0].shape[0] / pictures[0].shape[1])
    columns = []
    for picture, caption, color in zip(pictures, captions, colors, strict=True):
        small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        bar = np.full((_BAR, width, 3), 255, np.uint8)
        for text, right in zip(caption, (False, True), strict=True):
            (length, _), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
            x = width - length - 4 if right else 4
            cv2.putText(bar, text, (x, 20), _FONT, _FONT_SCALE, color, 1, cv2.LINE_AA)
        columns += [np.vstack([bar, small]), np.full((_BAR + height, _GAP, 3), 255, np.uint8)]
    return np.asarray(np.hstack(columns[:-1]), np.uint8)


def gif(pictures: Sequence[Image], frame_rate: float) -> bytes:
    """An animated GIF of pictures (h,w,3), blue first, that is shown again and again.

    All share one palette, made of a few of them: colors do not flicker, and what stays the same
    costs nothing.
    """
    chosen = pictures[:: max(1, len(pictures) // 8)]
    sample = Pillow.fromarray(cv2.cvtColor(np.vstack(chosen), cv2.COLOR_BGR2RGB))
    palette = sample.quantize(_PALETTE)
    frames = [
        Pillow.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)).quantize(
            palette=palette, dither=Pillow.Dither.NONE
        )
        for picture in pictures
    ]
    file = io.BytesIO()
    # GIF counts in hundredths of a second.
    duration = 10 * max(2, round(100.0 / frame_rate))
    frames[0].save(
        file, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0,
        optimize=True,
    )  # fmt: skip
    return file.getvalue()


# Of a marker's side: the cube stands on the paper around it.
_SIDE = 1.5
# Points along an edge: the shutter bends it.
_POINTS = 24
# Binary digits of a pixel that OpenCV's drawing takes.
_SHIFT = 4
_OPACITY = 0.35
_LINE_WIDTH = 3

# Corner k is at the digits of k: x, y, z; the cube's frame is that of the marker below it.
_CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) - np.array([0.5, 0.5, 0.0])
# Corners of each face around it, anticlockwise from outside.
_FACES = np.array(
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
)

PosesAt = Callable[[Array], tuple[Array, Array]]


def cube_on(marker: Marker) -> Array:
    """Corners (8,3), m in the map, of a cube that stands on a marker like a box on a carpet."""
    return marker.pose(_SIDE * marker.size * _CORNERS)


def draw_cube(
    picture: Image, camera: Camera, poses_at: PosesAt, corners: Array, color: tuple[int, int, int]
) -> None:
    """Draw a cube into a picture (height, width, 3), each of its points at its own row's pose.

    Args:
        poses_at: row times (n,) to poses camera_from_map, as of ``Motion.at_rows``.
    """
    rotations, translations = poses_at(np.zeros(1))
    centre = -rotations[0].T @ translations[0]
    outlines = [_outline(camera, poses_at, corners[face]) for face in _FACES]
    if not all(np.all(np.isfinite(outline)) for outline in outlines):
        return  # partly behind the camera
    near = [_faces_viewer(corners[face], centre) for face in _FACES]
    fixed = [np.rint(outline * 2**_SHIFT).astype(np.int32) for outline in outlines]
    for outline, near_side in zip(fixed, near, strict=True):
        if not near_side:
            cv2.polylines(picture, [outline], True, color, 1, cv2.LINE_AA, _SHIFT)
    filled = picture.copy()
    for outline, near_side in zip(fixed, near, strict=True):
        if near_side:
            cv2.fillPoly(filled, [outline], color, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(filled, _OPACITY, picture, 1.0 - _OPACITY, 0.0, dst=picture)
    for outline, near_side in zip(fixed, near, strict=True):
        if near_side:
            cv2.polylines(picture, [outline], True, color, _LINE_WIDTH, cv2.LINE_AA, _SHIFT)


def _outline(camera: Camera, poses_at: PosesAt, face: Array) -> Array:
    """Raw pixels (n,2) of points all around a face (4,3)."""
    share = np.arange(_POINTS)[:, None] / _POINTS
    edges = [a + share * (b - a) for a, b in zip(face, np.roll(face, -1, axis=0), strict=True)]
    return project_rolling(camera, poses_at, np.concatenate(edges))[0]


def _faces_viewer(face: Array, centre: Array) -> bool:
    normal = np.cross(face[1] - face[0], face[2] - face[1])
    return bool(normal @ (centre - face[0]) > 0.0)


# Of the bundled motion: the hand turns the camera to and fro about all axes, up to 200 deg/s, and
# this marker is in view nearly all the time.
_START, _DURATION, _MARKER = 21.7, 3.2, 121
# Images before these, in which the tracking finds its feet; a camera in use has run for long.
RUN_UP = 10
# A picture for people, who do not need every second image, nor noise in it.
CLIP_SENSOR = ImageSettings(exposure=0.001)
_EVERY = 2
# Pictures per second: slower than it was, for the eye to follow.
_SHOWN_RATE = 10.0
_WIDTH = 360
# The two methods. Orange and blue differ for everyone, and in lightness.
P3P, OURS = "p3p", "localizer"
_COLORS = {P3P: (36, 138, 240), OURS: (190, 84, 10)}
_CAPTIONS = {P3P: "P3P: one pose per image", OURS: "ours: a pose for every row"}

Motions = Mapping[str, Motion | None]  # by method; None: no pose


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """What the eye sees, and how far the cube is from its place."""

    animation: bytes  # GIF
    errors: Mapping[str, Array]  # method -> (images,) px, of the cube's farthest corner


def clip_stamps(walls: MarkerWalls, most: int | None = None) -> list[int]:
    """The images of the clip, or its first ones, after RUN_UP that are not shown."""
    stamps = walls.stamps()
    start_ns = stamps[0] + round(_START * 1e9)
    first = next(k for k, stamp in enumerate(stamps) if stamp >= start_ns)
    whole = round(_DURATION * RATE)
    return stamps[first - RUN_UP : first + (whole if most is None else min(most, whole))]


def clip_cube(walls: MarkerWalls) -> Array:
    """Corners (8,3) of the cube of the clip."""
    return cube_on(walls.markers[_MARKER])


def draw_clip(
    walls: MarkerWalls,
    middles_ns: Sequence[int],
    images: Sequence[Image],
    motions: Sequence[Motions],
) -> Clip:
    """The cube in all images by the motions of both methods.

    Images in which the cube is cut off are shown, but not counted.
    """
    cube = clip_cube(walls)
    pictures: list[Image] = []
    errors: dict[str, list[float]] = {P3P: [], OURS: []}
    for middle_ns, image, estimates in zip(middles_ns, images, motions, strict=True):
        off = cube_errors(walls.motion, middle_ns, cube, estimates)
        pictures.append(_picture(image, cube, estimates, off))
        for name, value in off.items():
            errors[name].append(value)
    return Clip(gif(pictures[::_EVERY], _SHOWN_RATE), {k: np.array(v) for k, v in errors.items()})


def cube_errors(
    motion: TrueMotion, middle_ns: int, cube: Array, motions: Motions
) -> dict[str, float]:
    """How far the cube's farthest corner is off in the image, px, for each method.

    Infinite without a pose; empty when the cube is not all in the image.
    """
    true = project_rolling(CAMERA, true_poses_at(CAMERA, motion, middle_ns), cube)[0]
    if not np.all(CAMERA.inside(true)):
        return {}
    errors = {}
    for name, estimate in motions.items():
        if estimate is None:
            errors[name] = np.inf
        else:
            seen = project_rolling(CAMERA, estimate.at_rows, cube)[0]
            off = np.linalg.norm(seen - true, axis=1).max()
            errors[name] = float(np.nan_to_num(off, nan=np.inf))
    return errors


def _picture(image: Image, cube: Array, motions: Motions, off: Mapping[str, float]) -> Image:
    """The image once for each method, with its cube and what it is off by."""
    pictures: list[Image] = []
    captions: list[Sequence[str]] = []
    for name, motion in motions.items():
        picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if motion is not None:
            draw_cube(picture, CAMERA, motion.at_rows, cube, _COLORS[name])
        pictures.append(picture)
        error = "no pose" if motion is None else ""
        if motion is not None and name in off:
            error = f"off by {off[name]:.0f} px" if off[name] >= 1.0 else "off by less than 1 px"
        captions.append((_CAPTIONS[name], error))
    return side_by_side(pictures, captions, [_COLORS[name] for name in motions], _WIDTH)
