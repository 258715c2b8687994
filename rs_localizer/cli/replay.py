"""``rs_localizer replay``: a recording -> poses and twists, offline or through the graph."""

from __future__ import annotations

import argparse
import importlib
import json
import shlex
import shutil
import time
from collections import Counter
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer.broadcasts import broadcast
from rs_localizer.cli import UsageError
from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.frames import FrameLocalizer
from rs_localizer.io.bags import STORAGES, BagReader, BagWriter, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import Frame, messages
from rs_localizer.io.trajectories import Trajectory, Twists, write_tum, write_twists
from rs_localizer.io.transforms import TransformError, make_transform
from rs_localizer.replay import (
    NO_FRAMES,
    TF_TYPE,
    Topics,
    find_topics,
    find_transforms,
    replay,
    tf_topics,
)
from rs_localizer.settings import NODE_NAME, build, load_params_file, parse_assignment
from rs_localizer.smoothed_frames import smooth_frames

# What replay writes into its output directory.
POSES, TWISTS, RESULT, BRIDGED = "poses.txt", "twists.txt", "result", "bridged.txt"
# Notices of a frame that could not follow the one before.
_RESTARTS = ("time_went_back", "map_changed")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help="rosbag2 (MCAP, sqlite3) or ROS 1 bag"
    )
    topics = parser.add_argument_group("topics of the recording (default: found by name and type)")
    topics.add_argument("--correspondences", metavar="TOPIC")
    topics.add_argument("--camera-info", metavar="TOPIC")
    topics.add_argument("--keypoints", metavar="TOPIC", help="instead of correspondences")
    topics.add_argument("--map-points", metavar="TOPIC", help="the map of the keypoints")
    offline = parser.add_argument_group(
        "offline (default): at full speed, no ROS needed",
        "With the settings base_frame and publish_tf, transforms come from the recording's "
        f"/tf_static and /tf, and go to /tf of {RESULT}.",
    )
    offline.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"directory to create, for {POSES} (TUM), {TWISTS} and the bag {RESULT} "
        "(default: BAG_replay)",
    )
    offline.add_argument("--overwrite", action="store_true", help="replace an earlier result")
    offline.add_argument(
        "--params", type=Path, metavar="FILE", help="settings: a ROS 2 params file"
    )
    offline.add_argument(
        "-p",
        dest="assignments",
        action="append",
        default=[],
        metavar="NAME:=VALUE",
        help="one setting, as after --ros-args; may be repeated",
    )
    offline.add_argument(
        "--map",
        type=Path,
        metavar="FILE",
        help="the map of the keypoints: as -p map_file:=FILE",
    )
    offline.add_argument(
        "--smooth",
        action="store_true",
        help="one motion through all images, from those before and after each; images without a "
        f"pose are bridged where their neighbours determine them, and listed in {BRIDGED}",
    )
    offline.add_argument("--storage", choices=list(STORAGES), default="mcap")
    graph = parser.add_argument_group("through the ROS graph")
    graph.add_argument(
        "--ros",
        action="store_true",
        help="publish the recording, with /clock and its /tf, for a live node",
    )
    graph.add_argument(
        "--rate",
        type=float,
        metavar="R",
        help="times real time, with --ros (default: 1); with --smooth: samples of the motion, Hz "
        "(default: one for each image)",
    )


def run(args: argparse.Namespace) -> None:
    _check_usage(args)
    if args.ros:
        with open_bag(args.bag) as bag:
            _play(bag, _find_topics(bag, args), args.rate or 1.0)
        return
    given = [] if args.map is None else [f"map_file:={json.dumps(str(args.map))}"]
    config = _config(args.params, args.assignments + given)
    notices: Counter[str] = Counter()
    with open_bag(args.bag) as bag:
        topics = _find_topics(bag, args)
        if topics.keypoints and not topics.map_points and not config.map_file:
            raise ValueError(
                f"{args.bag} has keypoints and no map on map_points; give one with --map"
            )
        transforms = find_transforms(bag, topics, config)
        localizer = FrameLocalizer(config, lambda name, _: notices.update((name,)), transforms)
        localizer.load_map()
        if args.smooth and config.readout_time == 0.0:
            raise ValueError("--smooth needs the readout time: -p readout_time:=SECONDS")
        out = args.out or Path(f"{args.bag.resolve().with_suffix('').name}_replay")
        _prepare(out, args.overwrite)
        _hint(args.bag, args.params)
        _replay(bag, topics, localizer, notices, out, args.storage, args.smooth, args.rate)


def _find_topics(bag: BagReader, args: argparse.Namespace) -> Topics:
    return find_topics(bag, args.correspondences, args.camera_info, args.keypoints, args.map_points)


def _check_usage(args: argparse.Namespace) -> None:
    if args.correspondences is not None and args.keypoints is not None:
        raise UsageError("give --correspondences or --keypoints, not both")
    if args.rate is not None and not 0.0 < args.rate < float("inf"):
        raise UsageError(f"--rate must be positive, got {args.rate}")
    if not args.ros:
        if args.rate is not None and not args.smooth:
            raise UsageError(
                "--rate goes with --ros or --smooth; offline replay runs at full speed"
            )
        return
    given = (args.out, args.params, args.assignments, args.map, args.overwrite, args.smooth)
    if any(given):
        raise UsageError(
            "--out, --overwrite, --params, --map, --smooth and -p are for offline replay; with "
            "--ros the running node has the settings and publishes the result"
        )


def _config(params: Path | None, assignments: list[str]) -> NodeConfig:
    try:
        values = {} if params is None else load_params_file(params)
    except ValueError as error:
        raise UsageError(f"--params: {error}") from error
    try:
        FrameLocalizer(build(values))  # refuses what it cannot do
    except ValueError as error:
        raise UsageError(f"--params: {params}: {error}") from error
    try:
        config = build(values | dict(map(parse_assignment, assignments)))
        FrameLocalizer(config)
    except ValueError as error:
        raise UsageError(f"-p: {error}") from error
    return config


def _prepare(out: Path, overwrite: bool) -> None:
    if out.exists() and not overwrite:
        raise ValueError(f"{out} exists; choose another --out, or --overwrite")
    if out.exists() and not _is_ours(out):
        raise ValueError(f"{out} is no result of replay; --overwrite leaves it as it is")
    out.mkdir(parents=True, exist_ok=True)
    for name in (POSES, TWISTS, BRIDGED):
        (out / name).unlink(missing_ok=True)
    if (out / RESULT / "metadata.yaml").exists():  # nothing but a recording is removed
        shutil.rmtree(out / RESULT)


def _is_ours(out: Path) -> bool:
    """Whether a directory holds an earlier result, or nothing."""
    return out.is_dir() and ((out / RESULT / "metadata.yaml").is_file() or not any(out.iterdir()))


def _hint(bag: Path, params: Path | None) -> None:
    file = (bag if bag.is_dir() else bag.parent) / "parameters.yaml"
    if params is None and file.is_file():
        print(f"the recording has settings of its own: --params {shlex.quote(str(file))}")


def _replay(
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    notices: Counter[str],
    out: Path,
    storage: str,
    smooth: bool,
    rate: float | None,
) -> None:
    localizer.warm_up()
    frames: list[Frame] = []
    last = "nothing came"
    refused: Counter[str] = Counter()
    not_sent = 0
    total = bag.count([topics.frames])
    start = time.perf_counter()
    # The bar is for a person who waits: none in a log file.
    with (
        BagWriter(out / RESULT, storage) as writer,
        tqdm(total=total, unit="frame", desc="replay", disable=None) as bar,
    ):
        for recorded_ns, result in replay(bag, topics, localizer):
            if result:
                frames.append(result)
                if not smooth:
                    not_sent += not _write_frame(writer, result, localizer, recorded_ns)
            else:
                refused[result.reason] += 1
                last = f"{result.reason}: {result.detail}"
            bar.update(1 if result or result.reason not in NO_FRAMES else 0)
        localized = len(frames)
        if smooth and frames:
            stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
            smoothed = smooth_frames(localizer, frames, stamps, rate)
            frames = smoothed.frames
            for frame in frames:
                not_sent += not _write_frame(writer, frame, localizer, frame.input_stamp_ns)
            text = "".join(f"{stamp // 10**9}.{stamp % 10**9:09}\n" for stamp in smoothed.bridged)
            (out / BRIDGED).write_text(text, encoding="utf-8")
    seconds = time.perf_counter() - start
    repeated = _write_texts(out, frames)
    _print_summary(total, localized, frames, refused, notices, repeated, not_sent, seconds)
    if smooth and frames:
        print(f"{'samples of the smoothed motion':40} {len(frames):8}")
        print(f"{f'  bridged, listed in {BRIDGED}':40} {len(smoothed.bridged):8}")
        print(f"{'  left out, not determined':40} {smoothed.undetermined:8}")
    moving = any(frame.twist for frame in frames)
    if frames and not moving:
        print(f"no twists: {_why_no_twists(localizer.config)}")
    print(f"written to {out}: {POSES}, {f'{TWISTS}, ' if moving else ''}{RESULT}")
    if not frames:
        raise ValueError(f"no frame of {bag.path} was localized; of the last one, {last}")


def _write_frame(
    writer: BagWriter, frame: Frame, localizer: FrameLocalizer, recorded_ns: int
) -> bool:
    """Write all messages of a frame; whether its transform could be told."""
    for name, message in messages(frame, writer.make).items():
        writer.write(f"/{NODE_NAME}/{name}", message, recorded_ns)
    return _write_transform(writer, frame, localizer, recorded_ns)


def _write_transform(
    writer: BagWriter, frame: Frame, localizer: FrameLocalizer, recorded_ns: int
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
        writer.write("/tf", writer.make(TF_TYPE, transforms=[transform]), recorded_ns)
    return True


def _write_texts(out: Path, frames: list[Frame]) -> int:
    """Write poses and twists in the order of their stamps; how many stamps came repeatedly."""
    stamps = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
    first = np.unique(stamps, return_index=True)[1]
    once = [frames[i] for i in first]
    write_tum(
        out / POSES,
        Trajectory(
            stamps_ns=stamps[first],
            positions=np.array([f.pose.position for f in once]).reshape(-1, 3),
            quaternions=np.array([_quaternion(f) for f in once]).reshape(-1, 4),
        ),
    )
    moving = [(f.stamp_ns, f.twist) for f in once if f.twist is not None]
    if moving:
        twists = Twists(
            stamps_ns=np.array([stamp for stamp, _ in moving], dtype=np.int64),
            angular=np.array([twist.angular for _, twist in moving]),
            linear=np.array([twist.linear for _, twist in moving]),
        )
        write_twists(out / TWISTS, twists)
    return len(frames) - len(once)


def _quaternion(frame: Frame) -> so3.Array:
    return so3.quaternion(np.ascontiguousarray(frame.pose.rotation))


def _print_summary(
    total: int,
    localized: int,
    frames: list[Frame],
    refused: Counter[str],
    notices: Counter[str],
    repeated: int,
    not_sent: int,
    seconds: float,
) -> None:
    rows = [("frames", total), ("localized", localized)]
    rows += [(f"  refused: {reason}", count) for reason, count in refused.most_common()]
    for name, count in notices.most_common():
        rows.append((f"{'started afresh' if name in _RESTARTS else 'noticed'}: {name}", count))
    dropped = sum(frame.dropped for frame in frames)
    rows += [("rows dropped (not finite)", dropped)] if dropped else []
    rows += [("stamps repeated, not in the text files", repeated)] if repeated else []
    rows += [("without a transform on /tf", not_sent)] if not_sent else []
    for name, count in rows:
        print(f"{name:40} {count:8}")
    print(f"{'frames per second':40} {total / seconds:8.0f}")


def _why_no_twists(config: NodeConfig) -> str:
    if config.readout_time == 0.0:
        return "readout_time is 0 (unknown); give it with -p readout_time:=SECONDS"
    return f"solver {config.solver} estimates no velocities"


def _play(bag: BagReader, topics: Topics, rate: float) -> None:
    try:  # by name: whoever has no ROS replays offline
        play = importlib.import_module("rs_localizer.ros.player").play
    except ImportError as error:
        raise ValueError(
            f"--ros needs ROS 2 ({error}): source a ROS 2 workspace, or install rclpy with pip "
            "(README.md)"
        ) from error
    names = (*_playable_transforms(bag), *topics.names)
    total = bag.count(names)
    played = play(
        tqdm(bag.messages(names), total=total, unit="message", desc="play", disable=None),
        {name: bag.topics[name] for name in names},
        rate,
        latched=() if topics.map_points is None else (topics.map_points,),
    )
    frames = bag.count([topics.frames])
    print(f"{frames} frames published in {played.seconds:.1f} s")
    for topic, count in played.poses.items():
        print(f"{count} poses heard on {topic}")
    if not played.poses:
        print(f"no node {NODE_NAME} was there to publish poses")


def _playable_transforms(bag: BagReader) -> list[str]:
    topics = tf_topics(bag, TF_TYPE)
    try:
        importlib.import_module("tf2_msgs.msg")
    except ImportError:
        if topics:
            missing = "tf2_msgs is not installed (ros-jazzy-tf2-msgs)"
            print(f"not played: {' and '.join(topics)}, {missing}")
        return []
    return topics
