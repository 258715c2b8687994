# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of a replay -> a recording of the Rerun viewer, or the viewer itself."""

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.io.atomic_files import atomic_files
from rs_localizer.io.bags import BagReader
from rs_localizer.io.clouds import read_correspondences, read_keypoints
from rs_localizer.io.images import Gray, read_any_image
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.io.remote import is_url, url_name
from rs_localizer.io.topics import COMPRESSED_IMAGE, CORRESPONDENCES
from rs_localizer.offline.image_sources import image_topics
from rs_localizer.offline.replay import Topics, inlier_columns
from rs_localizer.pipeline.frames import FrameLocalizer

TIMELINE = "stamp"
"""Of the images, as ``header.stamp`` says it."""

MAP = "map"
LANDMARKS = "map/landmarks"
INLIERS = "map/inliers"
PATH = "map/path"
BODY = "map/body"
COVARIANCE = "map/covariance"
READOUT = "map/readout"
CAMERA = "map/camera"
IMAGE = "map/camera/image"
MATCHES = "map/camera/image/inliers"
RESIDUALS = "map/camera/image/residuals_x{}"
OTHERS = "map/camera/image/others"
REFUSED = "refused"

ANGULAR, LINEAR = "plots/angular_velocity", "plots/linear_velocity"
RESIDUAL, COUNTS, DEVIATION = "plots/residual", "plots/counts", "plots/deviation"
PLOTS = {
    ANGULAR: "angular velocity (rad/s)",
    LINEAR: "linear velocity (m/s)",
    RESIDUAL: "residual rms, model error (px)",
    COUNTS: "points, inliers with rolling and global shutter",
    DEVIATION: "standard deviation: position (mm), orientation (mrad)",
}
"""What is drawn over time, and its title."""


Colours = NDArray[np.uint8]

# 95 % of the chi-square distribution with three degrees of freedom.
_WITHIN = np.sqrt(7.8147)
# The first row is blue, the last one yellow: both are seen on gray images, by everybody.
_FIRST, _LAST = np.array([0.0, 114.0, 255.0]), np.array([255.0, 220.0, 0.0])
# px that a typical residual is to be drawn at most, and by which factors.
_SEEN, _STEPS = 15.0, (1, 2, 5, 10, 20, 50, 100, 200, 500)
_INSTANTS = np.linspace(-0.5, 0.5, 9)


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Where a position lies with a probability of 95 %, of its covariance (3,3), m^2.

    Returns:
        half its sizes (3,) m, ascending; quaternion (4,) x y z w of its axes in the map.
    """
    values, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    half_sizes = _WITHIN * np.sqrt(np.maximum(values, 0.0))
    return half_sizes, so3.quaternion(np.ascontiguousarray(axes))


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """The inliers of a frame, and where its motion sees them, each at the time of its row."""

    points: Array  # (k,3) m, map
    pixels: Array  # (k,2) raw, as they were matched
    predicted: Array  # (k,2) raw
    colours: Colours  # (k,3) by the row: from blue, the first one, to yellow


def reproject(frame: Localized, camera: Camera) -> Reprojection:
    """Project the inliers through the shutter that the frame was localized with."""
    points, pixels = inlier_columns(frame, "xyz"), inlier_columns(frame, "uv")
    predicted, tau = project_rolling(camera, frame.estimate.at_rows, points)
    visible = np.isfinite(tau)
    return Reprojection(
        points[visible], pixels[visible], predicted[visible], row_colours(tau[visible])
    )


def enlargement(frames: Sequence[Localized]) -> int:
    """How much longer residuals are drawn so that one can see them: 1, 2, 5, 10, ..."""
    rms = [f.estimate.residual_rms for f in frames if f.estimate.inliers.any()]
    wanted = _SEEN / max(float(np.median(rms)), 1e-3) if rms else 1.0
    return max(step for step in _STEPS if step <= max(wanted, 1.0))


def row_colours(tau: Array) -> Colours:
    """Colours (k,3) of row times (k,), from -0.5 to 0.5."""
    share = np.clip(np.asarray(tau) + 0.5, 0.0, 1.0)[:, None]
    colours: Colours = np.round((1.0 - share) * _FIRST + share * _LAST).astype(np.uint8)
    return colours


def readout_path(frame: Localized) -> Array:
    """Camera centres (9,3) in the map, from the first row to the last."""
    rotations, translations = frame.estimate.at_rows(_INSTANTS)
    centres: Array = -np.einsum("nji,nj->ni", rotations, translations)
    return centres


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """From where a viewer looks at the scene."""

    position: Array  # (3,) m, map
    target: Array  # (3,) m
    up: Array  # (3,)
    depth: float  # m from the camera to its points, by which things are drawn large or small


def eye(frames: Sequence[Localized]) -> Eye:
    """Behind the camera of the middle frame and above it, looking at what it sees.

    Args:
        frames: one or more.
    """
    frame = next((it for it in frames[len(frames) // 2 :] if len(it.inliers)), frames[0])
    rotation, translation = frame.estimate.at(0.0)
    centre = -rotation.T @ translation
    right, down, ahead = rotation
    points = inlier_columns(frame, "xyz") if len(frame.inliers) else centre + ahead[None]
    target = np.median(points, axis=0)
    depth = float(np.linalg.norm(target - centre))
    position = centre + depth * (0.6 * right - 0.5 * down - 0.7 * ahead)
    return Eye(position, 0.5 * (target + centre), -down, depth)


def others(pixels: Array, frame: Localized | None) -> Array:
    """The pixels (m,2) of an image that are no inliers of its frame."""
    if frame is None or len(frame.inliers) == 0:
        return pixels
    kept = {tuple(pixel) for pixel in inlier_columns(frame, "uv").tolist()}
    out = [tuple(pixel) not in kept for pixel in pixels.tolist()]
    rest: Array = pixels[np.array(out, np.bool_)]
    return rest


_MEDIA = {b"\xff\xd8": "image/jpeg", b"\x89P": "image/png"}


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """An image: compressed as it came where viewers can read that, else gray."""

    stamp_ns: int
    data: bytes | Gray
    media_type: str = ""  # of the bytes


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Where an image was matched, or has keypoints."""

    stamp_ns: int
    pixels: Array  # (n,2) raw
    points: Array  # (n,3) m, map; of keypoints (0,3)


def shown(bag: BagReader, topics: Topics) -> Iterator[Picture | Cloud]:
    """All that can be read of these."""
    matched = CORRESPONDENCES in topics.of
    pictures = _picture_topic(bag)
    wanted = [topics.frames, *([] if pictures is None else [pictures])]
    for topic, _, message in bag.messages(wanted):
        try:
            item = _picture(message) if topic == pictures else _cloud(message, matched)
        except MessageError:  # replay has refused it, too
            continue
        yield item


def _picture_topic(bag: BagReader) -> str | None:
    """The only one, or that of the name that ``detect --images`` gives; else none can be meant."""
    topics = image_topics(bag)
    named = [topic for topic in topics if topic.strip("/") == COMPRESSED_IMAGE]
    chosen = topics if len(topics) == 1 else named
    return chosen[0] if len(chosen) == 1 else None


def _picture(message: Any) -> Picture:
    stamp = stamp_ns(message)
    if hasattr(message, "format"):
        data = bytes(message.data)
        media_type = _MEDIA.get(data[:2], "")
        if media_type:
            return Picture(stamp, data, media_type)
    return Picture(stamp, read_any_image(message).pixels)


def _cloud(message: Any, matched: bool) -> Cloud:
    if matched:
        correspondences = read_correspondences(message)
        return Cloud(correspondences.stamp_ns, correspondences.pixels, correspondences.points)
    keypoints = read_keypoints(message)
    return Cloud(keypoints.stamp_ns, keypoints.pixels, np.zeros((0, 3)))


Series = dict[str, tuple[list[str], Array]]
_COMPONENTS, _UNKNOWN = ["x", "y", "z"], np.full(3, np.nan)


def series(frames: Sequence[Localized]) -> Series:
    """By path: the names of k curves, and their values (n,k), NaN where there is none."""
    estimates = [frame.estimate for frame in frames]
    spread = [np.sqrt(np.diag(frame.pose.covariance)) for frame in frames]
    twists = [frame.twist for frame in frames]
    # A sample of a smoothed motion between images has no residual.
    rms = [e.residual_rms if np.any(e.inliers) else np.nan for e in estimates]
    curves: dict[str, tuple[list[str], list[Any]]] = {
        ANGULAR: (_COMPONENTS, [t.angular if t else _UNKNOWN for t in twists]),
        LINEAR: (_COMPONENTS, [t.linear if t else _UNKNOWN for t in twists]),
        RESIDUAL: (
            ["residual of the inliers", "model error"],
            [[of, e.model_error] for of, e in zip(rms, estimates, strict=True)],
        ),
        COUNTS: (
            ["points", "inliers, rolling shutter", "inliers, global shutter"],
            [[len(e.inliers), e.inliers.sum(), e.global_shutter_inliers] for e in estimates],
        ),
        DEVIATION: (
            ["position", "orientation"],
            [[1e3 * np.linalg.norm(s[:3]), 1e3 * np.linalg.norm(s[3:])] for s in spread],
        ),
    }
    return {path: (names, np.array(rows, float)) for path, (names, rows) in curves.items()}


def blueprint(with_images: bool, eye: Eye) -> Any:
    """Scene and image on the left, what changes with time on the right, one time line below.

    Args:
        with_images: whether there are any.
        eye: from where the scene is seen.
    """
    import rerun.blueprint as rrb

    scene = rrb.Spatial3DView(
        origin=MAP,
        name="map: path, covariance (95 %), landmarks, inliers",
        eye_controls=rrb.EyeControls3D(
            position=eye.position, look_target=eye.target, eye_up=eye.up
        ),
    )
    image = rrb.Spatial2DView(
        origin=IMAGE,
        name=f"{'image' if with_images else 'pixels'}: inliers by row (blue first), residuals "
        "enlarged, the others red",
    )
    plots = [rrb.TimeSeriesView(origin=path, name=name) for path, name in PLOTS.items()]
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(scene, image), rrb.Vertical(*plots), column_shares=[3, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


_APPLICATION = "rs_localizer"
_TIMEOUT = 60.0  # s, for a viewer to take everything
_SCREENS, _INSTEAD = ("DISPLAY", "WAYLAND_DISPLAY"), "--rerun writes a file"
# Size of the image and of the body's axes in the scene: shares of the distance to the points.
_PLANE, _AXES = 0.3, 0.12
# More landmarks than this are thinned out.
_MOST_LANDMARKS = 200_000
_GRAY, _RED, _ORANGE, _BLUE = (150, 150, 150), (230, 60, 40), (240, 150, 0), (70, 130, 255)


def write_view(
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    frames: Sequence[Localized],
    file: Path | None,
) -> None:
    """Show the frames of a replay beside what their recording holds.

    Args:
        bag, topics: what was replayed.
        localizer: by which, after its last frame.
        frames: with a pose, one or more.
        file: to write; None: a viewer is opened.

    Raises:
        ImportError: without the Rerun SDK.
        OutputError: when the file cannot be written.
        ValueError: when no viewer starts.
    """
    import rerun as rr

    calibration, config = localizer.calibration, localizer.config
    assert calibration is not None  # without one there is no frame
    camera = calibration.camera(config.readout_time, config.scan_direction)
    name = url_name(bag.path) if is_url(bag.path) else Path(bag.path).resolve().name
    # The viewer keeps what its user has arranged by application: for each recording on its own.
    stream = rr.RecordingStream(f"{_APPLICATION} {name}", recording_id=name)
    items = list(shown(bag, topics))
    look = eye(frames)
    arranged = blueprint(any(isinstance(item, Picture) for item in items), look)
    scene = _Scene(stream, camera, frames, look.depth)
    landmarks = np.zeros((0, 3)) if localizer.map is None else localizer.map.points
    if file is None:
        _start_viewer(stream, arranged)
        scene.log(items, landmarks)
        stream.flush(timeout_sec=_TIMEOUT)
        return
    with atomic_files(file) as (part,):
        part.touch()  # what cannot be written says so here
        stream.save(part, default_blueprint=arranged)
        scene.log(items, landmarks)
        stream.flush()
        stream.disconnect()


def check_screen() -> None:
    """Raise ``ValueError`` where no viewer can open.

    It would end at once, and what is sent to it would wait for ever.
    """
    if sys.platform == "linux" and not any(map(os.environ.get, _SCREENS)):
        raise ValueError(f"the Rerun viewer needs a screen ({' or '.join(_SCREENS)}); {_INSTEAD}")


def _start_viewer(stream: Any, arranged: Any) -> None:
    # Beside the interpreter, where pip puts it; that need not be on the path.
    beside = str(Path(sys.executable).parent)
    os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", os.defpath), beside])
    try:
        stream.spawn(default_blueprint=arranged)
    except (OSError, RuntimeError) as error:
        reason = str(error).partition(". ")[0]
        raise ValueError(
            f"the Rerun viewer does not start: {reason}; --rerun writes a file"
        ) from error


class _Scene:
    """Logs to one stream.

    Args:
        depth: m from the camera to its points, by which things are drawn large or small.
    """

    def __init__(
        self, stream: Any, camera: Camera, frames: Sequence[Localized], depth: float
    ) -> None:
        self._stream, self._camera, self._depth = stream, camera, depth
        self._longer = enlargement(frames)
        self._residuals = RESIDUALS.format(self._longer)
        by_stamp = {frame.input_stamp_ns: frame for frame in frames}
        self._frames = {stamp: by_stamp[stamp] for stamp in sorted(by_stamp)}

    def log(self, items: Sequence[Picture | Cloud], landmarks: Array) -> None:
        self._log_still(items, landmarks)
        for item in items:
            self._stream.set_time(TIMELINE, timestamp=_time(item.stamp_ns))
            if isinstance(item, Picture):
                self._log_picture(item)
            else:
                self._log_pixels(item)
        for stamp, frame in self._frames.items():  # those of a smoothed motion, too
            self._stream.set_time(TIMELINE, timestamp=_time(stamp))
            self._log_pose(frame)
        self._log_series()

    def _log_still(self, items: Sequence[Picture | Cloud], landmarks: Array) -> None:
        import rerun as rr

        clouds = [item.points for item in items if isinstance(item, Cloud)]
        points = np.unique(np.concatenate([landmarks, *clouds]), axis=0)
        points = points[:: 1 + len(points) // _MOST_LANDMARKS]
        path = [frame.pose.position for frame in self._frames.values()]
        self._stream.log(LANDMARKS, rr.Points3D(points, colors=_GRAY, radii=-1.5), static=True)
        self._stream.log(PATH, rr.LineStrips3D([path], colors=_BLUE, radii=-1.0), static=True)
        camera = self._camera
        self._stream.log(
            IMAGE,
            rr.Pinhole(
                image_from_camera=camera.K,
                resolution=camera.size,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=_PLANE * self._depth,
            ),
            static=True,
        )

    def _log_picture(self, picture: Picture) -> None:
        import rerun as rr

        if isinstance(picture.data, bytes):
            image: Any = rr.EncodedImage(contents=picture.data, media_type=picture.media_type)
        else:
            image = rr.Image(picture.data, color_model="L")
        self._stream.log(IMAGE, image)

    def _log_pixels(self, cloud: Cloud) -> None:
        """The matches of an image by what became of them."""
        import rerun as rr

        frame = self._frames.get(cloud.stamp_ns)
        rest = others(cloud.pixels, frame)
        self._stream.log(OTHERS, rr.Points2D(_centred(rest), colors=_RED, radii=-2.0))
        if frame is None:
            for path in (MATCHES, self._residuals, INLIERS):
                self._stream.log(path, rr.Clear(recursive=False))
            self._stream.log(REFUSED, rr.TextLog("no pose", level=rr.TextLogLevel.WARN))
            return
        pairs = reproject(frame, self._camera)
        ends = pairs.pixels + self._longer * (pairs.predicted - pairs.pixels)
        strips = np.stack([_centred(pairs.pixels), _centred(ends)], axis=1)
        self._stream.log(
            MATCHES, rr.Points2D(_centred(pairs.predicted), colors=pairs.colours, radii=-3.0)
        )
        self._stream.log(self._residuals, rr.LineStrips2D(list(strips), colors=_ORANGE))
        self._stream.log(INLIERS, rr.Points3D(pairs.points, colors=pairs.colours, radii=-3.0))

    def _log_pose(self, frame: Localized) -> None:
        import rerun as rr

        rotation, translation = frame.estimate.at(0.0)
        self._stream.log(
            CAMERA, rr.Transform3D(translation=-rotation.T @ translation, mat3x3=rotation.T)
        )
        self._stream.log(
            BODY,
            rr.Transform3D(translation=frame.pose.position, mat3x3=frame.pose.rotation),
            rr.TransformAxes3D(_AXES * self._depth),
        )
        half_sizes, quaternion = ellipsoid(frame.pose.covariance[:3, :3])
        self._stream.log(
            COVARIANCE,
            rr.Ellipsoids3D(
                centers=[frame.pose.position],
                half_sizes=[half_sizes],
                quaternions=[rr.Quaternion(xyzw=quaternion)],
                colors=_ORANGE,
            ),
        )
        self._stream.log(READOUT, rr.LineStrips3D([readout_path(frame)], colors=_ORANGE))

    def _log_series(self) -> None:
        import rerun as rr

        stamps = [_time(stamp) for stamp in self._frames]
        for path, (names, values) in series(list(self._frames.values())).items():
            self._stream.log(path, rr.SeriesLines(names=names), static=True)
            rr.send_columns(
                path,
                indexes=[rr.TimeColumn(TIMELINE, timestamp=stamps)],
                columns=rr.Scalars.columns(scalars=values),
                recording=self._stream,
            )


def _time(stamp_ns: int) -> np.datetime64:
    return np.datetime64(stamp_ns, "ns")


def _centred(pixels: Array) -> Array:
    """Rerun has the corner of the first pixel at 0, 0, we its centre."""
    return pixels + 0.5
