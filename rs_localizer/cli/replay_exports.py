"""What replay writes for other programs: poses at any row, and nerfstudio's ``transforms.json``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rs_localizer.cli.given import row_time
from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagReader
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.nerfstudio import View, middle_of_image, transforms
from rs_localizer.io.outputs import Localized
from rs_localizer.io.trajectories import Trajectory, write_tum
from rs_localizer.offline.image_sources import IMAGE_TYPES
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import middle_row_ns, pose_at, twist_at
from rs_localizer.pipeline.refusal import Refusal

TRANSFORMS, IMAGES = "transforms.json", "images"
_ROW_FILES = "poses_{}.txt"
_PNG = b"\x89PNG"


def add_export_arguments(parser: argparse._ActionsContainer) -> None:
    """For :func:`write_exports`."""
    parser.add_argument(
        "--row",
        dest="rows",
        action="append",
        default=[],
        metavar="ROW",
        type=_named_row,
        help="also write poses_ROW.txt (TUM), at the exposure of this row of each image: first, "
        "middle, last, or a row time from -0.5 to 0.5; may be repeated",
    )
    parser.add_argument(
        "--nerfstudio",
        action="store_true",
        help=f"also write {TRANSFORMS}, with velocities and rolling-shutter time, and to "
        f"{IMAGES}/ the compressed images of the recording",
    )


def written_names(out: Path) -> list[Path]:
    """What an earlier result holds of these."""
    return [*out.glob(_ROW_FILES.format("*")), *out.glob(TRANSFORMS), *out.glob(f"{IMAGES}/*")]


def write_exports(
    args: argparse.Namespace,
    bag: BagReader,
    localizer: FrameLocalizer,
    frames: list[Localized],
    out: Path,
) -> None:
    """Write what was asked for.

    Args:
        args: of :func:`add_export_arguments`; ``smooth`` among them.
        bag: the recording.
        localizer: that made the frames; it has their camera.
        frames: those with a pose.
        out: directory of the result.
    """
    calibration = localizer.calibration
    if calibration is None or not frames or not (args.rows or args.nerfstudio):
        return
    config = localizer.config
    camera = calibration.camera(config.readout_time, config.scan_direction)
    once = {frame.input_stamp_ns: frame for frame in frames}
    moments = _Moments(localizer, camera, calibration.frame, args.smooth)
    ordered = [once[stamp] for stamp in sorted(once)]
    for name, tau in args.rows:
        _write_row(out / _ROW_FILES.format(name), name, [moments.at(f, tau) for f in ordered])
    if args.nerfstudio:
        _write_transforms(bag, camera, moments, ordered, out)


class _Moments:
    """Pose and twist of frames at rows of their images."""

    def __init__(
        self, localizer: FrameLocalizer, camera: Camera, body: str, smoothed: bool
    ) -> None:
        self._localizer = localizer
        self._camera = camera
        self._body = body
        self._smoothed = smoothed

    def of_camera(self, frame: Localized, tau: float) -> Localized:
        """The frame at the exposure of a row."""
        config = self._localizer.config
        middle = middle_row_ns(config, self._camera, frame.input_stamp_ns)
        stamp = middle + round(1e9 * config.readout_time * tau)
        # A sample of a smoothed motion is centred on its own moment instead of the middle row.
        if self._smoothed:
            tau = (stamp - frame.stamp_ns) * 1e-9 / config.readout_time
        twist = None
        if frame.twist is not None:
            twist = twist_at(frame.estimate, tau, config.readout_time)
        return replace(
            frame,
            stamp_ns=stamp,
            body_frame=self._body,
            pose=pose_at(frame.estimate, tau),
            twist=twist,
        )

    def at(self, frame: Localized, tau: float) -> Localized | Refusal:
        """The same of ``base_frame``."""
        return self._localizer.mounted(self.of_camera(frame, tau))


def _named_row(text: str) -> tuple[str, float]:
    return text, row_time(text)


def _write_row(path: Path, name: str, frames: Iterable[Localized | Refusal]) -> None:
    known = [frame for frame in frames if isinstance(frame, Localized)]
    write_tum(
        path,
        Trajectory(
            stamps_ns=np.array([frame.stamp_ns for frame in known], np.int64),
            positions=np.array([frame.pose.position for frame in known]).reshape(-1, 3),
            quaternions=np.array(
                [so3.quaternion(np.ascontiguousarray(frame.pose.rotation)) for frame in known]
            ).reshape(-1, 4),
        ),
        [f"map_from_body; t: s, the exposure of the row {name} (-0.5 first, 0.5 last)"],
    )


def _write_transforms(
    bag: BagReader, camera: Camera, moments: _Moments, frames: list[Localized], out: Path
) -> None:
    files = _write_images(bag, {frame.input_stamp_ns for frame in frames}, out)
    middle = middle_of_image(camera)
    views = []
    for frame in frames:
        then = moments.of_camera(frame, middle)
        views.append(
            View(
                files.get(frame.input_stamp_ns, f"{IMAGES}/{frame.input_stamp_ns}.jpg"),
                then.pose.rotation,
                then.pose.position,
                None if then.twist is None else then.twist.linear,
                None if then.twist is None else then.twist.angular,
            )
        )
    text = json.dumps(transforms(camera, views), indent=1)
    (out / TRANSFORMS).write_text(text, encoding="utf-8")
    if missing := len(frames) - len(files):
        print(
            f"{missing} images of {TRANSFORMS} are not in the recording (detect --images keeps "
            f"them): put them to {IMAGES}/STAMP_IN_NS.jpg"
        )


def _write_images(bag: BagReader, stamps: set[int], out: Path) -> dict[int, str]:
    """The compressed images of these stamps; their files by stamp."""
    topics = [topic for topic, kind in bag.topics.items() if kind == IMAGE_TYPES[1]]
    files: dict[int, str] = {}
    if len(topics) != 1:
        return files
    (out / IMAGES).mkdir(exist_ok=True)
    for _, _, message in bag.messages(topics):
        stamp = stamp_ns(message)
        if stamp in stamps:
            data = bytes(message.data)
            suffix = "png" if data.startswith(_PNG) else "jpg"
            files[stamp] = f"{IMAGES}/{stamp}.{suffix}"
            (out / files[stamp]).write_bytes(data)
    return files
