"""``rs_localizer replay``: a recording -> poses and twists, offline or through the graph."""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections import Counter
from pathlib import Path

from tqdm import tqdm

from rs_localizer.cli import UsageError, many
from rs_localizer.cli.fleet import add_fleet_arguments, is_fleet
from rs_localizer.cli.given import add_settings, given_settings
from rs_localizer.cli.replay_exports import add_export_arguments, write_exports
from rs_localizer.cli.replay_result import (
    BRIDGED,
    POSES,
    RESULT,
    TWISTS,
    fresh,
    write_bridged,
    write_frame,
    write_texts,
)
from rs_localizer.cli.replay_ros import play
from rs_localizer.cli.replay_summary import Tally, print_summary
from rs_localizer.cli.replay_view import add_view_arguments, check_view, open_viewer, write_file
from rs_localizer.cli.topics import add_topics, given_topics
from rs_localizer.config import ImuUse, NodeConfig
from rs_localizer.io.bags import STORAGES, BagReader, BagWriter, is_bag, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.topics import IMU
from rs_localizer.offline.image_sources import holds_images, image_topics
from rs_localizer.offline.replay import (
    NO_FRAMES,
    Topics,
    find_topics,
    find_transforms,
    has_frames,
    imu_topics,
    replay,
)
from rs_localizer.offline.smoothed import smooth_frames
from rs_localizer.pipeline.frames import FrameLocalizer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="rosbag2 (MCAP, sqlite3) or ROS 1 bag; several: see many recordings",
    )
    topics = parser.add_argument_group("topics of the recording (default: found by name and type)")
    add_topics(topics)
    topics.add_argument("--no-imu", action="store_true", help="the camera alone")
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
        "(default: RECORDING_replay)",
    )
    offline.add_argument("--overwrite", action="store_true", help="replace an earlier result")
    add_settings(offline)
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
    add_export_arguments(offline)
    offline.add_argument("--storage", choices=list(STORAGES), default="mcap")
    graph = parser.add_argument_group("through the ROS graph")
    graph.add_argument(
        "--ros",
        action="store_true",
        help="publish the recording, images too, with /clock and its /tf, for live nodes",
    )
    graph.add_argument(
        "--rate",
        type=float,
        metavar="R",
        help="times real time, with --ros (default: 1); with --smooth: samples of the motion, Hz "
        "(default: one for each image)",
    )
    add_view_arguments(parser)
    add_fleet_arguments(parser)


def run(args: argparse.Namespace) -> None:
    _check_usage(args)
    check_view(args)
    if is_fleet(args):
        many.replay(args, settings_of(args))
        return
    recording: Path = args.recordings[0]
    if args.ros:
        _refuse_images(recording)
        with open_bag(recording) as bag:
            only_images = not has_frames(bag) and not (args.correspondences or args.keypoints)
            topics = None if only_images else find_topics(bag, given_topics(args))
            play(bag, topics, args.rate or 1.0, _played_imus(bag, args))
        return
    out = args.out or Path(f"{recording.resolve().with_suffix('').name}_replay")
    replay_one(args, recording, out)


def settings_of(args: argparse.Namespace) -> NodeConfig:
    """The settings that the arguments give; refuses those that cannot be."""
    given = [] if args.map is None else [f"map_file:={json.dumps(str(args.map))}"]
    return given_settings(args, given, FrameLocalizer)  # refuses what it cannot do


def _refuse_images(recording: Path) -> None:
    if not is_bag(recording) and (pictures := holds_images(recording)):
        raise ValueError(f"{recording} {pictures}, not matches: first {_detect_command(recording)}")


def replay_one(args: argparse.Namespace, recording: Path, out: Path, timed: bool = True) -> Tally:
    """Replay a recording into ``out``, and say what came of it (``timed``: how fast, too)."""
    _refuse_images(recording)
    config = settings_of(args)
    notices: Counter[str] = Counter()
    with open_bag(recording) as bag:
        if image_topics(bag) and not has_frames(bag):
            raise ValueError(
                f"{recording} holds images, not matches: first {_detect_command(recording)}"
            )
        topics = find_topics(bag, given_topics(args))
        if args.no_imu or config.imu.use == ImuUse.NONE:
            topics = topics.without(IMU)
        elif IMU not in topics.of and (several := imu_topics(bag)):
            print(f"no IMU is used: choose {' or '.join(several)} with --imu")
        if topics.lacks_map and not config.map_file:
            raise ValueError(f"{recording} has {topics.frames} and no map; give one with --map")
        transforms = find_transforms(bag, topics, config)
        localizer = FrameLocalizer(config, lambda name, _: notices.update((name,)), transforms)
        localizer.load_map()
        if args.smooth and config.readout_time == 0.0:
            raise ValueError("--smooth needs the readout time: -p readout_time:=SECONDS")
        with fresh(out, args.overwrite) as built:
            _hint(recording, args.params)
            tally = _replay(bag, topics, localizer, notices, built, args)
            view = write_file(args, bag, topics, localizer, tally, built)
        if view is not None:
            print(f"to look at: rerun {out / view.name if view.parent == built else view}")
        _tell(tally, config, out, timed)
        open_viewer(args, bag, topics, localizer, tally)
        if not tally.frames:
            raise ValueError(
                f"no frame of {bag.path} was localized; of the last one, {tally.last_refusal}"
            )
    return tally


def _detect_command(path: Path) -> str:
    """What finds the matches in images."""
    source = shlex.quote(str(path))
    calibration = "" if is_bag(path) else " --calibration camera.yaml"
    seen = shlex.quote(f"{path.resolve().with_suffix('').name}_seen")
    return (
        f"run: rs_localizer detect {source} --map MAP.yaml{calibration} --out {seen} (or --board "
        "6x4 --square 0.03, or --features sift, instead of --map), then: rs_localizer replay "
        f"{seen}"
    )


def _played_imus(bag: BagReader, args: argparse.Namespace) -> list[str]:
    """Topics of IMUs that live nodes shall hear."""
    if args.no_imu:
        return []
    return imu_topics(bag) if args.imu is None else [args.imu]


def _check_usage(args: argparse.Namespace) -> None:
    if args.imu is not None and args.no_imu:
        raise UsageError("give --imu or --no-imu, not both")
    if args.correspondences is not None and args.keypoints is not None:
        raise UsageError("give --correspondences or --keypoints, not both")
    if args.rate is not None and not 0.0 < args.rate < float("inf"):
        raise UsageError(f"--rate must be positive, got {args.rate}")
    if not args.ros:
        if args.rate is not None and args.nerfstudio:
            raise UsageError("--nerfstudio is of images, --rate of samples between them")
        if args.rate is not None and not args.smooth:
            raise UsageError(
                "--rate goes with --ros or --smooth; offline replay runs at full speed"
            )
        return
    if is_fleet(args):
        raise UsageError("--ros plays one recording, and needs no workers")
    given = (args.out, args.params, args.assignments, args.map, args.overwrite, args.smooth)
    if any((*given, args.rows, args.nerfstudio)):
        raise UsageError(
            "--out, --overwrite, --params, --map, --row, --nerfstudio, --smooth and -p are for "
            "offline replay; with --ros the running node has the settings and publishes the result"
        )


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
    args: argparse.Namespace,
) -> Tally:
    localizer.warm_up()
    tally = Tally(total=bag.count([topics.frames]), notices=notices)
    start = time.perf_counter()
    # The bar is for a person who waits: none in a log file.
    with (
        BagWriter(out / RESULT, args.storage) as writer,
        tqdm(total=tally.total, unit="frame", desc="replay", disable=None) as bar,
    ):
        for recorded_ns, result in replay(bag, topics, localizer):
            if result:
                tally.frames.append(result)
                if not args.smooth:
                    tally.not_sent += not write_frame(writer, result, localizer, recorded_ns)
            else:
                tally.refused[result.reason] += 1
                tally.last_refusal = f"{result.reason}: {result.detail}"
            bar.update(1 if result or result.reason not in NO_FRAMES else 0)
        if args.smooth and tally.frames:
            stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
            tally.smoothed = smooth_frames(localizer, tally.frames, stamps, args.rate)
            for frame in tally.written:
                tally.not_sent += not write_frame(writer, frame, localizer, frame.input_stamp_ns)
            write_bridged(out, tally.smoothed.bridged)
    tally.seconds = time.perf_counter() - start
    tally.imu = localizer.imu.state
    tally.repeated = write_texts(out, tally.written, localizer.config)
    write_exports(args, bag, localizer, tally.written, out)
    return tally


def _tell(tally: Tally, config: NodeConfig, out: Path, timed: bool) -> None:
    print_summary(tally, config, timed)
    moving = any(frame.twist for frame in tally.written)
    if tally.frames and not moving:
        print(f"no twists: {_why_no_twists(config)}")
    bridged = f", {BRIDGED}" if tally.smoothed else ""
    print(f"written to {out}: {POSES}, {f'{TWISTS}, ' if moving else ''}{RESULT}{bridged}")


def _why_no_twists(config: NodeConfig) -> str:
    if config.readout_time == 0.0:
        return "readout_time is 0 (unknown); give it with -p readout_time:=SECONDS"
    return f"solver {config.solver} estimates no velocities"
