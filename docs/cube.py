# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Draws the clip of README: ``python docs/cube.py`` writes ``cube.gif`` beside it.

Walls of markers are filmed along a recorded hand, and a cube is drawn into the images by the poses
of P3P and by those of the localizer.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

import rs_localizer as rsl
from rs_localizer import data
from rs_localizer.core.arrays import Array
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.trajectories import read_tum
from rs_localizer.io.video import Image
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.tools.simulation.renderer import ImageSettings, Renderer
from rs_localizer.tools.simulation.simulated_frames import frame_stamps, middle_stamp, true_poses_at
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import three_walls

PosesAt = Callable[[Array], tuple[Array, Array]]
CAMERA = rsl.Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
METHODS = "P3P: one pose per image", "ours: a pose for every row"
# Images before the clip, in which the tracking finds its feet; a camera in use has run long.
RUN_UP = 10
# Of the bundled motion: the hand turns the camera to and fro about all axes, up to 200 deg/s, and
# this marker is in view nearly all the time.
START, FRAMES, RATE, MARKER = 21.7, 96, 30.0, 121
EXPOSURE = 0.001  # s, of a row in a bright room: at 200 deg/s it blurs by 2 px
# Of a marker's side: the cube stands on the paper around it, like a box on a carpet.
SIDE = 1.5
# Along an edge, since the shutter bends it.
SHARES = np.linspace(0.0, 1.0, 24)[:, None]
# Corner k is at the digits of k: x, y, z; the cube's frame is that of the marker below it.
CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) - np.array([0.5, 0.5, 0.0])
EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
# Binary digits of a pixel that OpenCV's drawing takes.
SHIFT, OPACITY = 4, 0.35
# The images of the fastest second, pictures per second (slower than it was, for the eye), each px
# wide, and colours.
SHOWN, SHOWN_RATE, WIDTH, PALETTE = 30, 10.0, 360, 64
# Blue first. Orange and blue differ for everyone, and in lightness; the true outline is magenta,
# which neither the walls nor the cubes have.
COLOURS, TRUE = ((36, 138, 240), (190, 84, 10)), (200, 0, 200)


def corners_of(cube: Array, poses_at: PosesAt) -> Array:
    """Pixels (8,2) of the cube's corners."""
    return project_rolling(CAMERA, poses_at, cube)[0]


def edges_of(cube: Array, poses_at: PosesAt) -> list[NDArray[np.int32]]:
    """Edges (k,1,2) as OpenCV's drawing takes them; none partly behind the camera."""
    points = [cube[a] + SHARES * (cube[b] - cube[a]) for a, b in EDGES]
    pixels = project_rolling(CAMERA, poses_at, np.concatenate(points))[0]
    if not np.all(np.isfinite(pixels)):
        return []
    return list(np.rint(pixels * 2**SHIFT).astype(np.int32).reshape(len(EDGES), -1, 1, 2))


def picture(
    image: Image, cube: Array, true: PosesAt, motion: Motion | None, text: str,
    colour: tuple[int, int, int],
) -> Image:  # fmt: skip
    """The image with its cube, the outline of the true one, and what it is off by."""
    drawn = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    edges = [] if motion is None else edges_of(cube, motion.at_rows)
    if edges:
        filled, hull = drawn.copy(), cv2.convexHull(np.concatenate(edges))
        cv2.fillConvexPoly(filled, hull, colour, cv2.LINE_AA, SHIFT)
        cv2.addWeighted(filled, OPACITY, drawn, 1.0 - OPACITY, 0.0, dst=drawn)
        cv2.polylines(drawn, edges, False, colour, 2, cv2.LINE_AA, SHIFT)
    if edges := edges_of(cube, true):
        cv2.polylines(drawn, edges, False, TRUE, 1, cv2.LINE_AA, SHIFT)
    size = (WIDTH, round(WIDTH * image.shape[0] / image.shape[1]))
    small = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
    small = cv2.copyMakeBorder(small, 30, 0, 0, 6, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(small, text, (4, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
    return np.asarray(small, np.uint8)


def write_gif(pictures: list[Image], path: Path) -> None:
    """Pictures (h,w,3), blue first, shown again and again.

    All share one palette: colours do not flicker, and what stays the same costs nothing.
    """
    shown = [Pillow.fromarray(cv2.cvtColor(each, cv2.COLOR_BGR2RGB)) for each in pictures]
    chosen = [np.asarray(each) for each in shown[:: max(1, len(shown) // 8)]]
    palette = Pillow.fromarray(np.vstack(chosen)).quantize(PALETTE)
    frames = [each.quantize(palette=palette, dither=Pillow.Dither.NONE) for each in shown]
    frames[0].save(
        path, "GIF", save_all=True, append_images=frames[1:], duration=round(1e3 / SHOWN_RATE),
        loop=0, optimize=True,
    )  # fmt: skip


def main(out: Path, most: int = FRAMES) -> None:
    """Write the clip, and say by how much the cube is off by each method."""
    walk = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    scene = three_walls(sampled_states(walk))
    assert scene.marker_map is not None
    marker = scene.marker_map.markers[MARKER]
    cube = marker.pose(SIDE * marker.size * CORNERS)
    renderer = Renderer(CAMERA, scene.planes, ImageSettings(exposure=EXPOSURE))
    detector = MarkerDetector(scene.marker_map)
    p3p, tracker = rsl.Localizer(CAMERA, solver="p3p"), rsl.Tracker(rsl.Localizer(CAMERA))
    stamps = frame_stamps(walk, CAMERA, RATE)
    first = int(np.searchsorted(stamps, stamps[0] + round(START * 1e9)))
    images, trues, speeds = list[Image](), list[PosesAt](), list[float]()
    motions: dict[str, list[Motion | None]] = {name: [] for name in METHODS}
    for stamp in stamps[first - RUN_UP : first + most]:
        middle = middle_stamp(CAMERA, stamp)
        images.append(renderer.image(walk, stamp))
        trues.append(true_poses_at(CAMERA, walk, middle))
        seen = detector.detect(images[-1])
        found = (
            p3p.localize(seen.points, seen.pixels),
            tracker.localize(middle, seen.points, seen.pixels),
        )
        for name, result in zip(METHODS, found, strict=True):
            motions[name].append(result or None)
        whole = bool(np.all(CAMERA.inside(corners_of(cube, trues[-1]))))
        turn = float(np.linalg.norm(walk.state(middle, np.zeros(1)).angular[0]))
        speeds.append(turn if whole else np.nan)
    off = {
        name: [
            np.inf if motion is None
            else float(np.linalg.norm(corners_of(cube, motion.at_rows) - corners_of(cube, true),
                                      axis=1).max())
            for motion, true in zip(some, trues, strict=True)
        ]
        for name, some in motions.items()
    }  # fmt: skip
    count = min(SHOWN, most)
    of_clip = np.nan_to_num(speeds[RUN_UP:])
    start = RUN_UP + int(np.argmax(np.convolve(of_clip, np.ones(count), "valid")))
    write_gif(
        [
            np.hstack([
                picture(
                    images[k], cube, trues[k], motions[name][k],
                    f"{name}  {said(off[name][k] if speeds[k] > 0.0 else np.nan)}", colour,
                )
                for name, colour in zip(METHODS, COLOURS, strict=True)
            ])
            for k in range(start, start + count)
        ],
        out,
    )  # fmt: skip
    medians = [np.median(np.array(each)[RUN_UP:][of_clip > 0.0]) for each in off.values()]
    print(f"The cube's farthest corner is off by {medians[1]:.2f} px in the median, by "
          f"{medians[0]:.1f} px with P3P.\n{out}")  # fmt: skip


def said(off: float) -> str:
    """By how much the cube is off; nothing where it is cut off."""
    return f"off by {off:.0f} px" if off >= 1.0 else "off by less than 1 px" if off < 1.0 else ""


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("cube.gif"))
