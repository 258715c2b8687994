"""The cube in a few seconds of a shaking hand, drawn by P3P and by the localizer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.config import Acceleration
from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import Array
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.lab.animation import gif, side_by_side
from rs_localizer.lab.cube import Cube, corner_pixels, cube_on, draw_cube
from rs_localizer.lab.experiments.marker_frames import CAMERA, RATE, MarkerWalls
from rs_localizer.lab.experiments.results import Track
from rs_localizer.lab.rendering import ImageSettings
from rs_localizer.lab.simulation import true_poses_at
from rs_localizer.lab.true_motion import TrueMotion
from rs_localizer.lab.video import Image
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

# Of the bundled motion: the hand turns the camera to and fro about all axes, up to 200 deg/s, and
# this marker is in view nearly all the time.
START, DURATION, MARKER = 21.7, 3.2, 121
# Images before these, in which the tracking finds its feet; a camera in use has run for long.
_RUN_UP = 10
_FRAMES_PER_TRIAL = 0.05
_SAMPLES = 100
# A picture for people, who do not need every second image, nor noise in it.
_SENSOR = ImageSettings(exposure=0.002)
_EVERY = 2
_WIDTH = 360
# Of the picture: orange and blue differ for everyone, and in lightness.
COLORS = {"p3p": (36, 138, 240), "localizer": (190, 84, 10)}
CAPTIONS = {"p3p": "P3P: one pose per image", "localizer": "ours: a pose for every row"}


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """What the eye sees, and how far the cube is from its place."""

    animation: bytes  # GIF
    errors: Mapping[str, Array]  # method -> (images,) px, of the cube's farthest corner


def cube_clip(trajectory: Trajectory, trials: int, seed: int, track: Track) -> Clip:
    """Localize every image of the clip by both methods and draw the cube by their poses.

    Images in which the cube is cut off are shown, but not counted.
    """
    walls = MarkerWalls(trajectory, seed, _SENSOR)
    stamps = walls.stamps()
    start_ns = stamps[0] + round(START * 1e9)
    most = min(round(DURATION * RATE), max(8, round(_FRAMES_PER_TRIAL * trials)))
    first = next(k for k, stamp in enumerate(stamps) if stamp >= start_ns)
    chosen = stamps[first - _RUN_UP : first + most]
    cube = cube_on(walls.markers[MARKER])
    p3p = Localizer(CAMERA, solver="p3p", max_iterations=_SAMPLES)
    ours = Tracker(Localizer(CAMERA, max_iterations=_SAMPLES), Acceleration())
    pictures: list[Image] = []
    errors: dict[str, list[float]] = {"p3p": [], "localizer": []}
    for index, (frame, image) in enumerate(track(walls.frames(chosen), len(chosen))):
        found = {
            "p3p": p3p.localize(frame.points, frame.pixels),
            "localizer": ours.localize(frame.middle_ns, frame.points, frame.pixels),
        }
        if index < _RUN_UP:
            continue
        motions = {name: motion or None for name, motion in found.items()}
        off = cube_errors(walls.motion, frame.middle_ns, cube, motions)
        pictures.append(cube_picture(image, cube, motions, off))
        for name, value in off.items():
            errors[name].append(value)
    return Clip(gif(pictures[::_EVERY], RATE / _EVERY), {k: np.array(v) for k, v in errors.items()})


def cube_errors(
    motion: TrueMotion, middle_ns: int, cube: Cube, motions: Mapping[str, Motion | None]
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


def cube_picture(
    image: Image,
    cube: Cube,
    motions: Mapping[str, Motion | None],
    off: Mapping[str, float],
) -> Image:
    """The image once for each method, with its cube and what it is off by."""
    pictures: list[Image] = []
    captions: list[Sequence[str]] = []
    for name, motion in motions.items():
        picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if motion is not None:
            draw_cube(picture, CAMERA, motion.at_rows, cube, COLORS[name])
        pictures.append(picture)
        error = "no pose" if motion is None else ""
        if motion is not None and name in off:
            error = f"off by {off[name]:.0f} px" if off[name] >= 1.0 else "off by less than 1 px"
        captions.append((CAPTIONS[name], error))
    return side_by_side(pictures, captions, [COLORS[name] for name in motions], _WIDTH)
