# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Walls of markers along a recorded hand, filmed, and a cube that is drawn into the images.

By the poses of P3P and by those of the localizer: an animation for the eye.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.io.video import Image
from rs_localizer.markers.detection import Detections, MarkerDetector
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.simulation.renderer import Renderer, in_order
from rs_localizer.tools.simulation.simulated_frames import frame_stamps, middle_stamp, true_poses_at
from rs_localizer.tools.simulation.simulated_settings import ImageSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import three_walls

PosesAt = Callable[[Array], tuple[Array, Array]]
CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
RUN_UP = 10
"""Images before the clip, in which the tracking finds its feet; a camera in use has run long."""
# Of the bundled motion: the hand turns the camera to and fro about all axes, up to 200 deg/s, and
# this marker is in view nearly all the time.
_START, _FRAMES, _RATE, _MARKER = 21.7, 96, 30.0, 121
_EXPOSURE = 0.001  # s, of a row in a bright room: at 200 deg/s it blurs by 2 px
# Of a marker's side: the cube stands on the paper around it, like a box on a carpet.
_SIDE = 1.5
# Along an edge, since the shutter bends it.
_SHARES = np.linspace(0.0, 1.0, 24)[:, None]
# Corner k is at the digits of k: x, y, z; the cube's frame is that of the marker below it.
_CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) - np.array([0.5, 0.5, 0.0])
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
# Binary digits of a pixel that OpenCV's drawing takes.
_SHIFT, _OPACITY = 4, 0.35
# The images of the fastest second, pictures per second (slower than it was, for the eye), each px
# wide, and colors.
_SHOWN, _SHOWN_RATE, _WIDTH, _PALETTE = 30, 10.0, 360, 64
# Blue first. Orange and blue differ for everyone, and in lightness; the true outline is magenta,
# which neither the walls nor the cubes have.
_COLORS, _TRUE = ((36, 138, 240), (190, 84, 10)), (200, 0, 200)


class Walls:
    """Three walls around a recorded motion, the camera before them, and the cube on one marker."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.motion = RecordedMotion(trajectory)
        scene = three_walls(sampled_states(self.motion))
        assert scene.marker_map is not None
        self.cube = cube_on(scene.marker_map.markers[_MARKER])
        self._renderer = Renderer(CAMERA, scene.planes, ImageSettings(exposure=_EXPOSURE))
        self._detector = MarkerDetector(scene.marker_map)

    def stamps(self, most: int | None = None) -> list[int]:
        """Times of the clip's images, or of the first ones, after RUN_UP that are not shown."""
        stamps = frame_stamps(self.motion, CAMERA, _RATE)
        first = int(np.searchsorted(stamps, stamps[0] + round(_START * 1e9)))
        return stamps[first - RUN_UP : first + min(_FRAMES, most or _FRAMES)]

    def film(self, stamps_ns: Sequence[int]) -> Iterator[tuple[Image, Detections]]:
        """Images (height, width), and the markers that are detected there."""

        def frame(stamp_ns: int) -> tuple[Image, Detections]:
            image = self._renderer.image(self.motion, stamp_ns)
            return image, self._detector.detect(image)

        return in_order(frame, stamps_ns)

    def true_poses(self, stamp_ns: int) -> PosesAt:
        """The true poses of an image by row times."""
        return true_poses_at(CAMERA, self.motion, middle_stamp(CAMERA, stamp_ns))

    def fastest(self, stamps_ns: Sequence[int]) -> slice:
        """Those in a row that are shown: the camera turns fastest while it sees the whole cube."""
        still, speeds = np.zeros(1), np.zeros(len(stamps_ns))
        for k, stamp in enumerate(stamps_ns):
            if np.all(CAMERA.inside(self._true_corners(stamp))):
                state = self.motion.state(middle_stamp(CAMERA, stamp), still)
                speeds[k] = np.linalg.norm(state.angular[0])
        count = min(_SHOWN, len(speeds))
        start = int(np.argmax(np.convolve(speeds, np.ones(count), "valid")))
        return slice(start, start + count)

    def off(self, stamp_ns: int, motion: Motion | None) -> float:
        """How far the cube's farthest corner is off in the image, px; NaN where it is cut off."""
        true = self._true_corners(stamp_ns)
        if not np.all(CAMERA.inside(true)):
            return np.nan
        if motion is None:
            return np.inf
        seen = project_rolling(CAMERA, motion.at_rows, self.cube)[0]
        return float(np.nan_to_num(np.linalg.norm(seen - true, axis=1).max(), nan=np.inf))

    def _true_corners(self, stamp_ns: int) -> Array:
        return project_rolling(CAMERA, self.true_poses(stamp_ns), self.cube)[0]


def cube_on(marker: Marker) -> Array:
    """Corners (8,3), m in the map, of a cube that stands on a marker."""
    return marker.pose(_SIDE * marker.size * _CORNERS)


def draw_cube(
    picture: Image, camera: Camera, motion: Motion, corners: Array, color: tuple[int, int, int]
) -> None:
    """Draw a cube into a picture (height, width, 3), each of its points at its own row's pose."""
    edges = _edges(camera, motion.at_rows, corners)
    if edges is None:
        return
    filled = picture.copy()
    cv2.fillConvexPoly(filled, cv2.convexHull(edges.reshape(-1, 2)), color, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(filled, _OPACITY, picture, 1.0 - _OPACITY, 0.0, dst=picture)
    cv2.polylines(picture, list(edges), False, color, 2, cv2.LINE_AA, _SHIFT)


def _edges(camera: Camera, poses_at: PosesAt, corners: Array) -> NDArray[np.int32] | None:
    """Edges (e,k,1,2) as OpenCV's drawing takes them; None partly behind the camera."""
    points = [corners[a] + _SHARES * (corners[b] - corners[a]) for a, b in _EDGES]
    pixels = project_rolling(camera, poses_at, np.concatenate(points))[0]
    if not np.all(np.isfinite(pixels)):
        return None
    fixed = np.rint(pixels * 2**_SHIFT)
    return np.asarray(fixed.reshape(len(_EDGES), -1, 1, 2), np.int32)


def clip(
    walls: Walls, images: Sequence[Image], stamps_ns: Sequence[int],
    methods: Mapping[str, Sequence[Motion | None]],
) -> tuple[bytes, dict[str, Array]]:  # fmt: skip
    """An animated GIF of the cube by two methods, and by how many px it is off in the images.

    The GIF shows the fastest second, with the true outline; the figures are of all images.
    """
    off = {
        name: np.array([walls.off(*pair) for pair in zip(stamps_ns, motions, strict=True)])
        for name, motions in methods.items()
    }
    pictures = [
        np.hstack([
            _picture(
                images[k], (walls.cube, walls.true_poses(stamps_ns[k])), motions[k],
                f"{name}  {_said(off[name][k])}", color,
            )
            for (name, motions), color in zip(methods.items(), _COLORS, strict=True)
        ])
        for k in range(len(images))[walls.fastest(stamps_ns)]
    ]  # fmt: skip
    return _gif(pictures), {name: each[~np.isnan(each)] for name, each in off.items()}


def _said(off: float) -> str:
    return f"off by {off:.0f} px" if off >= 1.0 else "off by less than 1 px" if off < 1.0 else ""


def _picture(
    image: Image, true: tuple[Array, PosesAt], motion: Motion | None, text: str,
    color: tuple[int, int, int],
) -> Image:  # fmt: skip
    """The image with its cube, the outline of the true one, and what it is off by."""
    cube, poses_at = true
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    if motion is not None:
        draw_cube(picture, CAMERA, motion, cube, color)
    outline = _edges(CAMERA, poses_at, cube)
    if outline is not None:
        cv2.polylines(picture, list(outline), False, _TRUE, 1, cv2.LINE_AA, _SHIFT)
    size = (_WIDTH, round(_WIDTH * image.shape[0] / image.shape[1]))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    small = cv2.copyMakeBorder(small, 30, 0, 0, 6, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.putText(small, text, (4, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)
    return np.asarray(small, np.uint8)


def _gif(pictures: Sequence[Image]) -> bytes:
    """Pictures (h,w,3), blue first, shown again and again.

    All share one palette: colors do not flicker, and what stays the same costs nothing.
    """
    shown = [Pillow.fromarray(cv2.cvtColor(each, cv2.COLOR_BGR2RGB)) for each in pictures]
    chosen = [np.asarray(each) for each in shown[:: max(1, len(shown) // 8)]]
    palette = Pillow.fromarray(np.vstack(chosen)).quantize(_PALETTE)
    frames = [each.quantize(palette=palette, dither=Pillow.Dither.NONE) for each in shown]
    file = io.BytesIO()
    frames[0].save(
        file, "GIF", save_all=True, append_images=frames[1:], duration=round(1e3 / _SHOWN_RATE),
        loop=0, optimize=True,
    )  # fmt: skip
    return file.getvalue()
