"""The cube in a few seconds of a shaking hand, drawn by P3P and by the localizer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.shutter import Motion
from rs_localizer.evaluation.animation import gif, side_by_side
from rs_localizer.evaluation.cube import Cube, corner_pixels, cube_on, draw_cube
from rs_localizer.io.video import Image
from rs_localizer.simulation.frames import true_poses_at
from rs_localizer.simulation.marker_frames import CAMERA, RATE, MarkerWalls
from rs_localizer.simulation.renderer import ImageSettings
from rs_localizer.simulation.true_motion import TrueMotion

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


def clip_cube(walls: MarkerWalls) -> Cube:
    """The cube of the clip."""
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
    for middle_ns, image, found in zip(middles_ns, images, motions, strict=True):
        off = cube_errors(walls.motion, middle_ns, cube, found)
        pictures.append(_picture(image, cube, found, off))
        for name, value in off.items():
            errors[name].append(value)
    return Clip(gif(pictures[::_EVERY], _SHOWN_RATE), {k: np.array(v) for k, v in errors.items()})


def cube_errors(
    motion: TrueMotion, middle_ns: int, cube: Cube, motions: Motions
) -> dict[str, float]:
    """How far the cube's farthest corner is off in the image, px, for each method.

    Infinite without a pose; empty when the cube is not all in the image.
    """
    true = corner_pixels(CAMERA, true_poses_at(CAMERA, motion, middle_ns), cube)
    if not np.all(CAMERA.inside(true)):
        return {}
    errors = {}
    for name, found in motions.items():
        if found is None:
            errors[name] = np.inf
        else:
            off = np.linalg.norm(corner_pixels(CAMERA, found.at_rows, cube) - true, axis=1).max()
            errors[name] = float(np.nan_to_num(off, nan=np.inf))
    return errors


def _picture(
    image: Image,
    cube: Cube,
    motions: Motions,
    off: Mapping[str, float],
) -> Image:
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
