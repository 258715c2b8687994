# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay``: a recording -> poses and twists, offline or through the graph."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import shlex
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NoReturn

from rs_localizer.cli import WORKING, UsageError, detect, import_ros, with_values
from rs_localizer.cli.batch import add_batch_arguments, is_batch, run_batch
from rs_localizer.cli.image_input import add_telemetry, telemetry_of
from rs_localizer.cli.replay_result import (
    BRIDGED,
    POSES,
    RESULT,
    TWISTS,
    VIEW,
    Exports,
    Tally,
    add_export_arguments,
    check_places,
    figures,
    fresh,
    print_summary,
    write_frame,
)
from rs_localizer.cli.settings_args import add_settings, add_topics, given_settings, given_topics
from rs_localizer.io.bags import STORAGES, BagError, BagReader, BagWriter, is_bag, open_bag
from rs_localizer.io.remote import Location, check_writable, is_url, location, url_name

if WORKING:
    import numpy as np
    from tqdm import tqdm

    from rs_localizer.config import FeatureKind, ImuUse, NodeConfig
    from rs_localizer.io.maps.files import read_map_file
    from rs_localizer.io.maps.landmarks import Map
    from rs_localizer.io.messages import stamp_ns
    from rs_localizer.io.outputs import Localized
    from rs_localizer.io.recording import CAMERA, MAP, MAP_FRAME, PARAMETERS
    from rs_localizer.io.topics import IMU
    from rs_localizer.markers.formats import is_marker_file
    from rs_localizer.offline.fleet.task import Figures, Kind
    from rs_localizer.offline.image_sources import INFO_TYPE, holds_images, image_topics
    from rs_localizer.offline.replay import (
        NO_FRAMES,
        TF_TYPE,
        Answer,
        Topics,
        find_topics,
        has_frames,
        imu_topics,
        prepare,
        replay,
        tf_topics,
    )
    from rs_localizer.offline.smoothed import smooth_frames
    from rs_localizer.offline.table import (
        FrameTable,
        read_parquet,
        schema,
        write_parquet,
        write_zarr,
    )
    from rs_localizer.offline.viewing import check_screen, write_view
    from rs_localizer.pipeline.frames import FrameLocalizer
    from rs_localizer.pipeline.rigs import frame_localizer
    from rs_localizer.settings import NODE_NAME
    from rs_localizer.trajectory.warm_up import warm_up

if TYPE_CHECKING:  # an extra
    from pyarrow import Table

_SUFFIX = ".rrd"
_ORB_BYTES = 32  # of a descriptor; AKAZE's has 61
# The table of one recording of many, in its folder.
TABLE = "frames.parquet"
# Known by being this very object: a user's view.rrd is in the current directory, as any other name.
_BESIDE_POSES = Path(VIEW)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=location,
        nargs="+",
        metavar="RECORDING",
        help="rosbag2 (MCAP, sqlite3) or ROS 1 bag, or its URL (s3://, gs://, ...; needs "
        "'rs_localizer[table]'); with --map, a video, a folder or a bag of images; several: see "
        "many recordings",
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
        type=location,
        metavar="FILE",
        help="the map of the keypoints: as -p map_file:=FILE; of images, also markers or the "
        "result of map build, which brings the lens and the shutter",
    )
    offline.add_argument(
        "--calibration", type=Path, metavar="FILE", help="of images: the lens, as for detect"
    )
    add_telemetry(offline)
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
    _add_view_arguments(parser)
    add_batch_arguments(parser)


def run(args: argparse.Namespace) -> Figures | None:
    _check_usage(args)
    _check_view(args)
    if is_batch(args):
        check_places(args, None)
        _replay_batch(args, _settings(args))
        return None
    recording: Location = args.recordings[0]
    if args.ros:
        if is_url(recording) or not is_bag(Path(recording)):  # of a bag, images are played
            _refuse_images(recording)
        with open_bag(recording) as bag:
            only_images = not has_frames(bag) and not (args.correspondences or args.keypoints)
            topics = None if only_images else find_topics(bag, given_topics(args))
            imus = imu_topics(bag) if args.imu is None else [args.imu]
            _play(bag, topics, args.rate or 1.0, [] if args.no_imu else imus)
        return None
    out = args.out or Path(f"{_name(recording)}_replay")
    check_places(args, out)
    return {"out": str(out)} | figures(_replay_one(args, recording, out))


def _settings(args: argparse.Namespace) -> NodeConfig:
    """The settings that the arguments give; refuses those that cannot be."""
    assignments = [] if args.map is None else [f"map_file:={json.dumps(str(args.map))}"]
    return given_settings(args, assignments, frame_localizer)  # refuses what it cannot do


def _name(recording: Location) -> str:
    """A recording's own name, for what is made of it."""
    path = Path(url_name(recording)) if is_url(recording) else Path(recording).resolve()
    return path.with_suffix("").name


def _refuse_images(recording: Location) -> None:
    if pictures := _pictures(recording):
        raise ValueError(f"{recording} {pictures}, not matches: first {_detect_command(recording)}")


def _pictures(recording: Location) -> str:
    """What a recording holds instead of matches, as ``is a video``; empty: nothing of the kind."""
    if is_url(recording):
        return ""
    recording = Path(recording)
    if not is_bag(recording):
        return holds_images(recording)
    with open_bag(recording) as bag:
        return "holds images" if image_topics(bag) and not has_frames(bag) else ""


def _replay_one(
    args: argparse.Namespace, recording: Location, out: Path, timed: bool = True
) -> Tally:
    """Replay a recording into ``out``, and say what came of it (``timed``: how fast, too)."""
    if args.map is None or not _pictures(recording):
        _refuse_images(recording)
        return _replay_matches(args, recording, recording, out, timed)
    with TemporaryDirectory() as place:
        matches = Path(place) / "matches"
        parser = argparse.ArgumentParser()
        detect.add_arguments(parser)
        of_images = parser.parse_args(_detection(args, Path(recording), matches))
        of_images.images = Path(recording)
        by_markers = of_images.features is None
        (detect.detect_one if by_markers else detect.detect_features)(of_images)
        # What was given is in the file beside the matches now, with what the video says.
        own = matches / PARAMETERS
        telemetry = telemetry_of(Path(recording), args)
        alone = with_values(
            args, params=own if own.exists() else None, assignments=[],
            map=None if by_markers else _map_file(Path(args.map)),
            exposure=None if telemetry is None else telemetry.exposure,
        )  # fmt: skip
        return _replay_matches(alone, matches, recording, out, timed)


def _map_file(place: Path) -> Path:
    """The landmarks of the result of map build, or of a file."""
    return place / MAP if (place / MAP).is_file() else place


def _detection(args: argparse.Namespace, recording: Path, out: Path) -> list[str]:
    """The arguments of detect that find the matches of images."""
    if is_url(args.map):
        raise ValueError(f"the map of images has to be a file of this machine, got {args.map}")
    place = Path(args.map)
    if is_marker_file(place):
        words = ["--map", str(place)]
    else:
        words = ["--features", _features_of(read_map_file(_map_file(place), MAP_FRAME))]
    calibration, params = args.calibration, args.params
    built = place / MAP
    if built.is_file():  # a result of map build
        params = params or place / PARAMETERS
        lens = place / CAMERA
        calibration = calibration or (lens if lens.is_file() and not is_bag(recording) else None)
    for name, value in (("--calibration", calibration), ("--params", params)):
        words += [] if value is None else [name, str(value)]
    words += [word for item in args.assignments for word in ("-p", item)]
    words += ["--no-telemetry"] if args.no_telemetry else []
    exported = (args.nerfstudio, args.gsplat, args.ncore, args.rerun, args.view)
    words += ["--images"] if any(exported) else []
    return [str(recording), *words, "--out", str(out)]


def _features_of(landmarks: Map) -> str:
    if landmarks.descriptors is None:
        raise ValueError("the map has no descriptors: keypoints of images cannot be matched to it")
    if landmarks.descriptors.dtype == np.float32:
        return FeatureKind.SIFT.value
    orb = landmarks.descriptors.shape[1] == _ORB_BYTES
    return (FeatureKind.ORB if orb else FeatureKind.AKAZE).value


def _replay_matches(
    args: argparse.Namespace, path: Location, recording: Location, out: Path, timed: bool
) -> Tally:
    """Replay the bag ``path``, whose images or matches are those of ``recording``."""
    config = _settings(args)
    if args.no_imu:
        config = replace(config, imu=replace(config.imu, use=ImuUse.NONE))
    notices: dict[str, tuple[int, str]] = {}

    def notice(name: str, text: str) -> None:
        notices[name] = notices.get(name, (0, ""))[0] + 1, text

    _refuse_for_rigs(args, config)
    with open_bag(path) as bag:
        topics, localizer = prepare(bag, config, given_topics(args), notice)
        unused = IMU not in topics.of and config.imu.use != ImuUse.NONE
        if unused and (several := imu_topics(bag)):
            print(f"no IMU is used: choose {' or '.join(several)} with --imu")
        if args.smooth and config.readout_time == 0.0 and not config.is_rig:
            raise ValueError("--smooth needs the readout time: -p readout_time:=SECONDS")
        localizer.warm_up()
        wanted = args.parquet is not None or args.zarr is not None
        table = FrameTable(recording) if wanted else None
        tally = Tally(bag.count([topics.frames]), notices, table)
        with fresh(out, args.overwrite) as built:
            _hint(path, args.params)
            frames = _replay(bag, topics, localizer, tally, built, args)
            view = _write_view(args, bag, topics, localizer, frames, built)
        if view is not None:
            print(f"to look at: rerun {out / view.name if view.parent == built else view}")
        _tell(tally, config, out, timed)
        if table is not None:
            _write_table(args, [table.table()])
        # The result is there, whether the viewer starts or not.
        if args.view and frames:
            write_view(bag, topics, localizer, frames, None)
        if not tally.localized:
            raise ValueError(
                f"no frame of {recording} was localized; of the last one, {tally.last_refusal}"
            )
    return tally


def _refuse_for_rigs(args: argparse.Namespace, config: NodeConfig) -> None:
    options = ("nerfstudio", "gsplat", "ncore", "rerun", "view", "parquet", "zarr")
    given = [name for name in options if getattr(args, name)] + (["row"] if args.rows else [])
    if config.is_rig and given:
        raise UsageError(f"--{given[0]} is for one camera: leave it out with cameras")


def _write_table(args: argparse.Namespace, tables: Iterable[Table]) -> None:
    """The tables of one recording or of many, as ``--parquet`` and ``--zarr`` ask for them."""
    tables = list(tables)
    if args.parquet is not None:
        rows = write_parquet(tables, args.parquet)
        print(f"written to {args.parquet}: {rows} rows, one a frame")
    if args.zarr is not None:
        frames = write_zarr(tables, args.zarr)
        print(f"written to {args.zarr}: {frames} frames of {len(tables)} episodes")


def _detect_command(path: Location) -> str:
    """What finds the matches in images."""
    source = shlex.quote(str(path))
    calibration = "" if is_url(path) or is_bag(Path(path)) else " --calibration camera.yaml"
    out = shlex.quote(f"{_name(path)}_seen")
    return (
        f"run: rs_localizer detect {source} --map MAP.yaml{calibration} --out {out} (or --board "
        "6x4 --square 0.03, or --features sift, instead of --map), then: rs_localizer replay "
        f"{out}"
    )


def _check_usage(args: argparse.Namespace) -> None:
    if args.imu is not None and args.no_imu:
        raise UsageError("give --imu or --no-imu, not both")
    if args.correspondences is not None and args.keypoints is not None:
        raise UsageError("give --correspondences or --keypoints, not both")
    if args.rate is not None and not 0.0 < args.rate < float("inf"):
        raise UsageError(f"--rate must be positive, got {args.rate}")
    if not args.ros:
        if args.rate is not None and (args.nerfstudio or args.gsplat or args.ncore):
            raise UsageError(
                "--nerfstudio, --gsplat and --ncore are of images, --rate of samples between"
            )
        if (args.gsplat or args.ncore) and is_batch(args):
            raise UsageError("--gsplat and --ncore are of one recording")
        if args.rate is not None and not args.smooth:
            raise UsageError(
                "--rate goes with --ros or --smooth; offline replay runs at full speed"
            )
        return
    if is_batch(args):
        raise UsageError("--ros plays one recording, and needs no workers")
    offline = (args.out, args.params, args.assignments, args.map, args.overwrite, args.smooth)
    exports = (args.nerfstudio, args.gsplat, args.ncore, args.parquet, args.zarr)
    if any((*offline, args.rows, *exports)):
        raise UsageError(
            "--out, --overwrite, --params, --map, --row, --nerfstudio, --gsplat, --ncore, "
            "--parquet, --zarr, --smooth, -p are for offline replay; with --ros the node has the "
            "settings and publishes the result"
        )


def _hint(recording: Location, params: Path | None) -> None:
    if is_url(recording):
        return
    bag = Path(recording)
    file = (bag if bag.is_dir() else bag.parent) / "parameters.yaml"
    if params is None and file.is_file():
        print(f"the recording has settings of its own: --params {shlex.quote(str(file))}")


def _localized(
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    tally: Tally,
    refused: list[Answer],
    bar: tqdm[NoReturn],
) -> Iterator[tuple[int, Localized]]:
    """The frames with a pose, and when they were recorded; the others are counted and kept."""
    for answer in replay(bag, topics, localizer):
        result = answer.result
        if result:
            tally.add(result)
            yield answer.recorded_ns, result
        else:
            tally.refuse(result)
            if result.reason in NO_FRAMES:
                continue
            if tally.table is not None:
                refused.append(answer)
        bar.update()


def _replay(
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    tally: Tally,
    out: Path,
    args: argparse.Namespace,
) -> list[Localized]:
    """Replay into ``out``; the frames of the result, where something needs all of them at once."""
    exports = Exports(args, localizer, out)
    whole: list[Localized] = []
    refused: list[Answer] = []
    smoothed: set[int] = set()  # stamps of images
    keep = args.rerun is not None or args.view
    start = time.perf_counter()
    # The bar is for a person who waits: none in a log file.
    with (
        BagWriter(out / RESULT, args.storage) as writer,
        tqdm(total=tally.total, unit="frame", desc="replay", disable=None) as bar,
    ):
        frames = _localized(bag, topics, localizer, tally, refused, bar)
        if args.smooth:
            stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
            parts = smooth_frames(localizer, (frame for _, frame in frames), stamps, args.rate)
            frames = (
                (frame.input_stamp_ns, frame) for part in parts for frame in tally.smooth(part)
            )
        for recorded_ns, frame in frames:
            tally.not_sent += not write_frame(writer, frame, localizer, recorded_ns)
            tally.track.add(frame)
            exports.add(frame)
            if tally.table is not None:
                tally.table.add(frame.input_stamp_ns, frame)
                if args.smooth:
                    smoothed.add(frame.input_stamp_ns)
            if keep:
                whole.append(frame)
    if tally.smoothed is not None:
        tally.write_bridged(out)
    if tally.table is not None:
        for answer in refused:
            if answer.stamp_ns not in smoothed:
                tally.table.add(answer.stamp_ns, answer.result)
    tally.seconds = time.perf_counter() - start
    if localizer.config.is_rig:
        # Images of several cameras are one frame.
        lost = sum(n for reason, n in tally.refused.items() if reason not in NO_FRAMES)
        tally.total = tally.localized + lost
    tally.imu = localizer.imu.state
    if (measured := localizer.readout_watch.measured) is not None:
        tally.readout = measured.readout_time, measured.deviation
    tally.repeated, tally.moving = tally.track.write(out, localizer.config.pose_time)
    exports.write(bag)
    return whole


def _tell(tally: Tally, config: NodeConfig, out: Path, timed: bool) -> None:
    print_summary(tally, config, timed)
    if tally.localized and not tally.moving:
        why = f"solver {config.solver} estimates no velocities"
        if config.readout_time == 0.0:
            why = "readout_time is 0 (unknown); give it with -p readout_time:=SECONDS"
        print(f"no twists: {why}")
    bridged = f", {BRIDGED}" if tally.smoothed else ""
    print(f"written to {out}: {POSES}, {f'{TWISTS}, ' if tally.moving else ''}{RESULT}{bridged}")


def _add_view_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "to look at, with Rerun (pip install 'rs_localizer[view]')",
        "Path, covariance, landmarks, inliers, images, residuals and velocities on one time line.",
    )
    group.add_argument(
        "--rerun",
        nargs="?",
        type=Path,
        const=_BESIDE_POSES,
        metavar="FILE.rrd",
        help=f"write a file for the viewer (default: {VIEW} beside the poses)",
    )
    group.add_argument("--view", action="store_true", help="open the viewer")


def _check_view(args: argparse.Namespace) -> None:
    """Refuse what cannot be shown before there is anything to show."""
    if args.rerun is None and not args.view:
        return
    if is_batch(args) or args.ros:
        raise UsageError("--rerun and --view show one recording, replayed offline")
    if args.rerun is not None and args.rerun.suffix != _SUFFIX:
        raise UsageError(
            f"--rerun FILE must end in {_SUFFIX}, got {args.rerun} (a recording stands before it)"
        )
    if args.rerun is not None and args.rerun is not _BESIDE_POSES:
        check_writable(args.rerun)
    if importlib.util.find_spec("rerun") is None:
        raise ValueError(
            "--rerun and --view need the Rerun SDK, which is not installed: "
            "pip install 'rs_localizer[view]'"
        )
    if args.view:
        check_screen()


def _write_view(
    args: argparse.Namespace,
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    frames: list[Localized],
    out: Path,
) -> Path | None:
    """Write what ``--rerun`` asks for; of no pose there is nothing to be seen."""
    if args.rerun is None or not frames:
        return None
    file: Path = out / VIEW if args.rerun is _BESIDE_POSES else args.rerun
    write_view(bag, topics, localizer, frames, file)
    return file


def _play(bag: BagReader, topics: Topics | None, rate: float, imus: list[str]) -> None:
    """Publish the inputs of the nodes: matches or keypoints, images, their camera_info, and TF.

    ``topics`` are those of the localizer's inputs; None: it has none, only images.
    """
    player = import_ros("player", "--ros")
    images = image_topics(bag)
    infos = sorted(topic for topic, kind in bag.topics.items() if kind == INFO_TYPE)
    inputs = images + (infos if topics is None else list(topics.names))
    if not images and topics is None:
        raise BagError(f"{bag.path} has nothing to play: no matches, keypoints or images")
    names = tuple(dict.fromkeys((*_transforms(bag), *imus, *inputs)))
    total = bag.count(names)
    latched = [] if topics is None else [t for t, item in topics.inputs.items() if item.lasting]
    played = player.play(
        tqdm(bag.messages(names), total=total, unit="message", desc="play", disable=None),
        {name: bag.topics[name] for name in names},
        rate,
        latched=latched,
    )
    if topics is not None:
        print(f"{bag.count([topics.frames])} frames published in {played.seconds:.1f} s")
    if images:
        print(f"{bag.count(images)} images published in {played.seconds:.1f} s")
    for topic, count in played.poses.items():
        print(f"{count} poses received on {topic}")
    if not played.poses:
        print(f"no node {NODE_NAME} was there to publish poses")


def _transforms(bag: BagReader) -> list[str]:
    topics = tf_topics(bag, TF_TYPE)
    try:
        importlib.import_module("tf2_msgs.msg")
    except ImportError:
        if topics:
            missing = "tf2_msgs is not installed (ros-jazzy-tf2-msgs)"
            print(f"not played: {' and '.join(topics)}, {missing}")
        return []
    return topics


def _replay_batch(args: argparse.Namespace, config: NodeConfig) -> None:
    kernels = f"replay {config.solver}{' smooth' if args.smooth else ''}"
    if config.map_file:  # where it is from here, whatever directory a worker is in
        args = with_values(args, map=location(config.map_file))
    files = args.params, args.map, args.calibration
    kind = Kind("replay", _replay_of_many, kernels, _replay_warm)
    wanted = args.parquet is not None or args.zarr is not None
    if wanted:
        schema()  # what is not installed is said before hours of work
    own = with_values(args, parquet=wanted, zarr=None)

    def gather(folders: Sequence[Path]) -> None:
        _write_table(args, (read_parquet(folder / TABLE) for folder in folders))

    run_batch(own, kind, lambda _: files, args.overwrite, gather if wanted else None)


def _replay_warm(args: argparse.Namespace) -> None:
    frame_localizer(_settings(args)).warm_up()
    if args.smooth:
        warm_up()


def _replay_of_many(args: argparse.Namespace, recording: Location, out: Path) -> Figures:
    alone = with_values(args, overwrite=False, parquet=out / TABLE if args.parquet else None)
    return figures(_replay_one(alone, recording, out, timed=False))
