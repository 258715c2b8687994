"""The directory that replay writes: poses and twists as text, and a bag with the node's topics."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rs_localizer.cli.replay_exports import written_names
from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.outputs import Localized, messages
from rs_localizer.io.topics import TF
from rs_localizer.io.trajectories import Trajectory, Twists, write_tum, write_twists
from rs_localizer.io.transforms.rigid import TransformError, make_transform
from rs_localizer.offline.fleet.identity import MARKER
from rs_localizer.offline.fleet.task import LOG
from rs_localizer.offline.replay import TF_TYPE
from rs_localizer.pipeline.broadcasts import broadcast
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.settings import NODE_NAME

POSES, TWISTS, RESULT, BRIDGED = "poses.txt", "twists.txt", "result", "bridged.txt"
VIEW = "view.rrd"
"""What replay writes into its output directory."""


@contextlib.contextmanager
def fresh(out: Path, overwrite: bool) -> Iterator[Path]:
    """Within ``with``, make a result, which then takes the place of ``out``."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        if not overwrite:
            raise ValueError(f"{out} exists; choose another --out, or --overwrite")
        if not _is_ours(out):
            raise ValueError(f"{out} is not a result of replay; --overwrite leaves it as it is")
    with atomic_directory(out, _remove_results if overwrite else None) as built:
        built.mkdir()
        yield built


def _remove_results(out: Path) -> None:
    if (out / MARKER).exists():  # of many recordings: what follows is no result of what it says
        (out / MARKER).unlink()
        (out / LOG).unlink(missing_ok=True)
    for name in (POSES, TWISTS, BRIDGED, VIEW):
        (out / name).unlink(missing_ok=True)
    for path in written_names(out):
        path.unlink(missing_ok=True)
    shutil.rmtree(out / RESULT, ignore_errors=True)


def _is_ours(out: Path) -> bool:
    """Whether a directory holds an earlier result, or nothing."""
    return out.is_dir() and ((out / RESULT / "metadata.yaml").is_file() or not any(out.iterdir()))


def write_frame(
    writer: BagWriter, frame: Localized, localizer: FrameLocalizer, recorded_ns: int
) -> bool:
    """Write all messages of a frame; whether its transform could be told."""
    for name, message in messages(frame, writer.make).items():
        writer.write(f"/{NODE_NAME}/{name}", message, recorded_ns)
    return _write_transform(writer, frame, localizer, recorded_ns)


def _write_transform(
    writer: BagWriter, frame: Localized, localizer: FrameLocalizer, recorded_ns: int
) -> bool:
    """Write what publish_tf asks for; whether it could be told."""
    try:
        item = broadcast(frame, localizer.config, localizer.transforms)
    except TransformError:
        return False
    if item is not None:
        transform = make_transform(
            writer.make, item.stamp_ns, item.parent, item.child, item.parent_from_child
        )
        writer.write(TF, writer.make(TF_TYPE, transforms=[transform]), recorded_ns)
    return True


def write_texts(out: Path, frames: list[Localized], config: NodeConfig) -> int:
    """Write poses and twists in the order of their stamps; how many stamps came repeatedly."""
    stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    first = np.unique(stamps, return_index=True)[1]
    once = [frames[i] for i in first]
    about = _about(once, config)
    write_tum(
        out / POSES,
        Trajectory(
            stamps_ns=stamps[first],
            positions=np.array([f.pose.position for f in once]).reshape(-1, 3),
            quaternions=np.array([_quaternion(f) for f in once]).reshape(-1, 4),
        ),
        about.poses,
    )
    moving = [(f.stamp_ns, f.twist) for f in once if f.twist is not None]
    if moving:
        twists = Twists(
            stamps_ns=np.array([stamp for stamp, _ in moving], dtype=np.int64),
            angular=np.array([twist.angular for _, twist in moving]),
            linear=np.array([twist.linear for _, twist in moving]),
        )
        write_twists(out / TWISTS, twists, about.twists)
    return len(frames) - len(once)


def write_bridged(out: Path, stamps_ns: IntArray) -> None:
    """Write the stamps (b,) of poses without an image of their own, in s, one a line."""
    text = "".join(f"{stamp // 10**9}.{stamp % 10**9:09}\n" for stamp in stamps_ns.tolist())
    (out / BRIDGED).write_text(text, encoding="utf-8")


class _About(NamedTuple):
    """What the text files say of themselves."""

    poses: list[str]
    twists: list[str]


def _about(frames: list[Localized], config: NodeConfig) -> _About:
    bodies = " or ".join(sorted({repr(frame.body_frame) for frame in frames})) or "the camera"
    maps = " or ".join(sorted({repr(frame.map_frame) for frame in frames})) or "the map"
    when = {
        PoseTime.STAMP.value: "the stamp of the image (pose_time: stamp)",
        PoseTime.MID_FRAME.value: "the exposure of its middle row (pose_time: mid_frame)",
    }[config.pose_time]
    time = f"t: s, {when}"
    return _About(
        [
            f"pose of {bodies} in {maps}, map_from_body; {time}",
            "x y z: m, its origin; qx qy qz qw: unit quaternion that turns its axes into the map's",
        ],
        [
            f"velocity of {bodies} with respect to {maps}, in its own axes; {time}",
            "wx wy wz: rad/s; vx vy vz: m/s, of its origin",
        ],
    )


def _quaternion(frame: Localized) -> Array:
    return so3.quaternion(np.ascontiguousarray(frame.pose.rotation))
