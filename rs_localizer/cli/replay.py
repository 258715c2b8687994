# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay``: a recording -> poses and twists, at full speed and without ROS."""

from __future__ import annotations

import csv
import fcntl
import functools
import importlib.util
import json
import math
import shlex
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NoReturn

from rs_localizer.cli import WORKING
from rs_localizer.cli.options import (
    CAMERA_FLAGS,
    Inputs,
    Many,
    Settings,
    UsageError,
    argument,
    option,
)
from rs_localizer.cli.replay_result import (
    BRIDGED,
    POSES,
    RESULT,
    TWISTS,
    Tally,
    figures,
    fresh,
    print_summary,
    write_frame,
)
from rs_localizer.cli.settings_args import given_settings, given_topics
from rs_localizer.io.atomic_files import atomic_files, check_writable, write_errors
from rs_localizer.io.bags import BagReader, BagWriter, is_bag, open_bag

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
    from rs_localizer.markers.map_files import is_marker_file
    from rs_localizer.offline.fleet import (
        Figures,
        Outcome,
        Task,
        finished,
        perform_all,
        tasks_of,
    )
    from rs_localizer.offline.image_sources import holds_images, image_topics
    from rs_localizer.offline.replay import (
        NO_FRAMES,
        Answer,
        Topics,
        has_frames,
        imu_topics,
        prepare,
        replay,
    )
    from rs_localizer.offline.table import FrameTable, read_parquet, schema, write_parquet
    from rs_localizer.pipeline.frames import FrameLocalizer

if TYPE_CHECKING:
    from pyarrow import Table  # an extra

    from rs_localizer.cli import detect  # of images only

_ORB_BYTES = 32  # of a descriptor; AKAZE's has 61
# Of each of many recordings, and of all.
TABLE, SUMMARY = "frames.parquet", "summary.csv"


@dataclass(frozen=True, kw_only=True)
class Options(Settings, Inputs, Many):
    recordings: list[Path] = argument(
        "rosbag2 (MCAP, sqlite3) or ROS 1 bag; with --map, a video, a folder or a bag of images",
        "RECORDING",
    )
    out: Path | None = option(
        f"directory to create, for {POSES} (TUM), {TWISTS} and the bag {RESULT}; of many, one for "
        "all (default: RECORDING_replay)", "DIR",
    )  # fmt: skip
    overwrite: bool = option("replace an earlier result", default=False)
    map: Path | None = option(
        "the map of the keypoints; of images, also markers or the result of map build, which "
        "brings the lens and the shutter", "FILE",
    )  # fmt: skip
    calibration: Path | None = option(
        "as calibrate writes it: lens and shutter; or a lens alone", "FILE", flag=CAMERA_FLAGS
    )
    smooth: bool = option(
        "one motion through all images, from those before and after each; images without a pose "
        f"are bridged where their neighbours determine them, and listed in {BRIDGED}",
        default=False,
    )
    rate: float | None = option(
        "poses of the motion, as the frames until then tell it, or with --smooth all "
        "(default: one for each image)", "HZ",
        limits=(0.0, math.inf), above=True,
    )  # fmt: skip
    parquet: Path | None = option(
        "also write one table of all recordings, a row a frame: poses, twists, covariances, why "
        "frames were refused (pip install 'rs_localizer[table]')", "FILE",
    )  # fmt: skip


def run(options: Options) -> Figures | None:
    _check_place(options)
    if len(options.recordings) > 1 or options.workers or options.scheduler:
        _replay_all(options)
        return None
    recording = options.recordings[0]
    out = options.out or Path(f"{_name(recording)}_replay")
    return {"out": str(out)} | figures(_replay_one(options, recording, out))


def _check_place(options: Options) -> None:
    """Refuse a table that could not be written, or would replace something else, before the work.

    Raises:
        ValueError: naming the place.
    """
    file = options.parquet
    if file is None:
        return
    schema()  # what is not installed is said now
    check_writable(file)
    if not file.is_file():
        return  # nothing is there, or what takes all that comes, such as /dev/stdout
    with file.open("rb") as content:
        if content.read(4) != b"PAR1":
            raise ValueError(f"{file} is no earlier result of --parquet, and stays as it is")
    if not options.overwrite:
        raise ValueError(f"{file} exists; choose another --parquet, or --overwrite")


def _settings(options: Options) -> NodeConfig:
    """The settings that the options give; refuses those that cannot be."""
    files = {"map_file": options.map, "camera_file": options.calibration}
    also = [f"{name}:={json.dumps(str(file))}" for name, file in files.items() if file is not None]
    return given_settings(options, also, FrameLocalizer)


def _name(recording: Path) -> str:
    """A recording's own name, for what is made of it."""
    return recording.resolve().with_suffix("").name


def _pictures(recording: Path) -> str:
    """What a recording holds instead of matches, as ``is a video``; empty: nothing of the kind."""
    if not is_bag(recording):
        return holds_images(recording)
    with open_bag(recording) as bag:
        return "holds images" if image_topics(bag) and not has_frames(bag) else ""


def _replay_one(options: Options, recording: Path, out: Path, timed: bool = True) -> Tally:
    """Replay a recording into ``out``, and say what came of it (``timed``: how fast, too)."""
    pictures = _pictures(recording)
    if not pictures:
        return _replay_matches(options, recording, recording, out, timed)
    if options.map is None:
        raise ValueError(f"{recording} {pictures}, not matches: first {_detect_command(recording)}")
    from rs_localizer.cli import detect

    with TemporaryDirectory() as place:
        matches = Path(place) / "matches"
        of_images = _detection(options, recording, matches)
        by_markers = of_images.features is None
        detect.detect(of_images)
        # What was given is in the file beside the matches now, with what the video says.
        own = matches / PARAMETERS
        alone = replace(
            options, params=own if own.exists() else None, assignments=[],
            map=None if by_markers else _map_file(options.map), remaps=[], calibration=None,
        )  # fmt: skip
        return _replay_matches(alone, matches, recording, out, timed)


def _map_file(place: Path) -> Path:
    """The landmarks of the result of map build, or of a file."""
    return place / MAP if (place / MAP).is_file() else place


def _detection(options: Options, recording: Path, out: Path) -> detect.Options:
    """What finds the matches of images."""
    from rs_localizer.cli import detect

    place = options.map
    assert place is not None
    by_markers = is_marker_file(place)
    features = None
    if not by_markers:
        features = _features_of(read_map_file(_map_file(place), MAP_FRAME))
    calibration, params = options.calibration, options.params
    if (place / MAP).is_file():  # a result of map build
        params = params or place / PARAMETERS
        lens = place / CAMERA
        calibration = calibration or (lens if lens.is_file() and not is_bag(recording) else None)
    return detect.Options(
        images=recording, out=out, map=place if by_markers else None, features=features,
        calibration=calibration, params=params, assignments=options.assignments,
        remaps=options.remaps,
    )  # fmt: skip


def _features_of(landmarks: Map) -> str:
    if landmarks.descriptors is None:
        raise ValueError("the map has no descriptors: keypoints of images cannot be matched to it")
    if landmarks.descriptors.dtype == np.float32:
        return FeatureKind.SIFT.value
    orb = landmarks.descriptors.shape[1] == _ORB_BYTES
    return (FeatureKind.ORB if orb else FeatureKind.AKAZE).value


def _replay_matches(options: Options, path: Path, recording: Path, out: Path, timed: bool) -> Tally:
    """Replay the bag ``path``, whose images or matches are those of ``recording``."""
    config = _settings(options)
    notices: dict[str, tuple[int, str]] = {}

    def notice(name: str, text: str) -> None:
        notices[name] = notices.get(name, (0, ""))[0] + 1, text

    if config.of_cameras and options.parquet is not None:
        raise UsageError("--parquet is for one camera: leave it out with cameras")
    with open_bag(path) as bag:
        topics, localizer = prepare(bag, config, given_topics(options), notice)
        unused = IMU not in topics.of and config.imu.use != ImuUse.NONE
        if unused and (several := imu_topics(bag)):
            print(f"no IMU is used: choose {' or '.join(several)} with -r imu:=TOPIC")
        if options.smooth and config.readout_time == 0.0 and not config.of_cameras:
            raise ValueError("--smooth needs the readout time: -p readout_time:=SECONDS")
        localizer.warm_up()
        table = None
        if options.parquet is not None:
            table = FrameTable(recording, localizer, options.smooth)
        tally = Tally(bag.count([topics.frames]), notices, table)
        with fresh(out, options.overwrite) as built:
            _hint(path, options.params)
            _replay(bag, topics, localizer, tally, built, options)
        _tell(tally, config, out, timed)
        if table is not None and options.parquet is not None:
            _write_table([table.table()], options.parquet)
        if not tally.localized:
            raise ValueError(
                f"no frame of {recording} was localized; of the last one, {tally.last_refusal}"
            )
    return tally


def _write_table(tables: list[Table], file: Path) -> None:
    rows = write_parquet(tables, file)
    print(f"written to {file}: {rows} rows, one a frame")


def _detect_command(path: Path) -> str:
    """What finds the matches in images."""
    calibration = "" if is_bag(path) else " --camera camera.yaml"
    out = shlex.quote(f"{_name(path)}_seen")
    return (
        f"run: rs_localizer detect {shlex.quote(str(path))} --map MAP.yaml{calibration} --out "
        f"{out} (or --board 6x4 --square 0.03, or --features sift, instead of --map), then: "
        f"rs_localizer replay {out}"
    )


def _hint(bag: Path, params: Path | None) -> None:
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
    options: Options,
) -> None:
    """Replay into ``out``."""
    refused: list[Answer] = []
    smoothed: set[int] = set()  # stamps of images
    start = time.perf_counter()
    # The bar is for a person who waits: none in a log file.
    with (
        BagWriter(out / RESULT) as writer,
        tqdm(total=tally.total, unit="frame", desc="replay", disable=None) as bar,
    ):
        frames = _localized(bag, topics, localizer, tally, refused, bar)
        if options.smooth:
            from rs_localizer.tools.smoothed import smooth_frames

            stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
            parts = smooth_frames(localizer, (frame for _, frame in frames), stamps, options.rate)
            frames = (
                (frame.input_stamp_ns, frame) for part in parts for frame in tally.smooth(part)
            )
        elif options.rate is not None:
            frames = _at_rate(frames, localizer, options.rate)
        for recorded_ns, frame in frames:
            tally.not_sent += not write_frame(writer, frame, localizer, recorded_ns)
            tally.track.add(frame)
            if tally.table is not None:
                tally.table.add(frame.input_stamp_ns, frame)
                if options.smooth:
                    smoothed.add(frame.input_stamp_ns)
    if tally.smoothed is not None:
        text = "".join(f"{stamp // 10**9}.{stamp % 10**9:09}\n" for stamp in tally.bridged)
        (out / BRIDGED).write_text(text, encoding="utf-8")
    if tally.table is not None:
        for answer in refused:
            if answer.stamp_ns not in smoothed:
                tally.table.add(answer.stamp_ns, answer.result)
    tally.seconds = time.perf_counter() - start
    if localizer.config.of_cameras:
        # Images of several cameras are one frame.
        lost = sum(n for reason, n in tally.refused.items() if reason not in NO_FRAMES)
        tally.total = tally.localized + lost
    tally.imu = localizer.imu.state
    if (measured := localizer.readout_watch.measured) is not None:
        tally.readout = measured.readout_time, measured.deviation
    tally.repeated, tally.moving = tally.track.write(out, localizer.config.pose_time)


def _at_rate(
    frames: Iterable[tuple[int, Localized]], localizer: FrameLocalizer, rate: float
) -> Iterator[tuple[int, Localized]]:
    """The motion so many times a second until each frame; frames where it is not known."""
    step_ns = max(round(1e9 / rate), 1)
    last_ns: int | None = None
    for recorded_ns, frame in frames:
        now_ns = frame.input_stamp_ns
        if not localizer.predicts:
            yield recorded_ns, frame
        elif last_ns is not None:
            # A longer gap ends the track.
            begin = max(last_ns, now_ns - 10**9) // step_ns + 1
            for time_ns in range(begin * step_ns, now_ns + 1, step_ns):
                if found := localizer.at(time_ns):
                    yield time_ns, found
        last_ns = now_ns


def _tell(tally: Tally, config: NodeConfig, out: Path, timed: bool) -> None:
    print_summary(tally, config, timed)
    if tally.localized and not tally.moving:
        why = f"solver {config.solver} estimates no velocities"
        if config.readout_time == 0.0:
            why = "readout_time is 0 (unknown); give it with -p readout_time:=SECONDS"
        print(f"no twists: {why}")
    bridged = f", {BRIDGED}" if tally.smoothed else ""
    print(f"written to {out}: {POSES}, {f'{TWISTS}, ' if tally.moving else ''}{RESULT}{bridged}")


def _replay_all(options: Options) -> None:
    """Replay many recordings, each into a folder of its own; what is complete is not done again."""
    out = options.out
    if out is None:
        raise UsageError("many recordings need --out DIR, for a folder of each")
    if options.workers is not None and options.scheduler is not None:
        raise UsageError("--workers are of this machine; give it or --scheduler")
    if importlib.util.find_spec("distributed") is None:
        raise ValueError(
            "many recordings need Dask, which is not installed: pip install 'rs_localizer[fleet]'"
        )
    config = _settings(options)  # refuses wrong ones before there are workers
    if options.map is None and config.map_file:  # where it is from here, not from a worker
        options = replace(options, map=Path(config.map_file))
    params, landmarks, lens = (
        None if place is None else place.absolute()
        for place in (options.params, options.map, options.calibration)
    )
    own = replace(
        options, recordings=[], out=None, overwrite=False, workers=None, scheduler=None,
        params=params, map=landmarks, calibration=lens,
        parquet=None if options.parquet is None else Path(TABLE),
    )  # fmt: skip
    files = [file for file in (params, landmarks, lens) if file is not None]
    work = functools.partial(_replay_of_many, own)
    tasks = tasks_of(options.recordings, out.absolute(), work, repr(own), files)
    for task in tasks:
        if task.folder.exists() and finished(task) is None and not options.overwrite:
            raise ValueError(
                f"{task.folder} exists and is no result of this recording, settings and version; "
                "choose another --out, or --overwrite"
            )
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"another command is writing into {out}; wait for its end") from None
        outcomes = _share_out(tasks, options)
    done = [task for task in tasks if outcomes[task.folder].figures is not None]
    if options.parquet is not None:
        _write_table([read_parquet(task.folder / TABLE) for task in done], options.parquet)
    if failed := len(tasks) - len(done):
        raise ValueError(f"{failed} of {len(tasks)} recordings failed; {out / SUMMARY} says why")


def _share_out(tasks: list[Task], options: Options) -> dict[Path, Outcome]:
    """What became of each, by its folder; the summary is written however it ends."""
    outcomes = {
        task.folder: Outcome(known, "") for task in tasks if (known := finished(task)) is not None
    }
    print(f"{len(outcomes)} of {len(tasks)} recordings have been done before")
    waiting = [task for task in tasks if task.folder not in outcomes]
    try:
        with tqdm(total=len(waiting), unit="recording", disable=None) as bar:
            made = perform_all(waiting, options.scheduler, options.workers) if waiting else ()
            for task, outcome in made:
                outcomes[task.folder] = outcome
                bar.update()
                bar.write(f"{task.folder.name}: {outcome.reason or 'done'}")
    finally:
        for task in tasks:  # what is done and has not been heard of, as after Ctrl-C
            known = finished(task)
            unheard = Outcome(known, "not done" if known is None else "")
            outcomes.setdefault(task.folder, unheard)
        _summarize(tasks, outcomes)
    return outcomes


def _summarize(tasks: list[Task], outcomes: dict[Path, Outcome]) -> None:
    """Write the table; it says the same whoever did the work, in whatever order it was done."""
    file = tasks[0].folder.with_name(SUMMARY)
    known = [outcomes[task.folder] for task in tasks]
    columns = list(dict.fromkeys(name for outcome in known for name in outcome.figures or ()))
    with atomic_files(file) as (part,), part.open("w", encoding="utf-8", newline="") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["recording", "folder", *columns, "reason"])
        for task, outcome in zip(tasks, known, strict=True):
            values = [(outcome.figures or {}).get(name, "") for name in columns]
            cells = [f"{v:.6g}" if isinstance(v, float) else str(v) for v in values]
            row = [str(task.recording), task.folder.name, *cells, outcome.reason]
            # Text that a spreadsheet does not take for a formula.
            writer.writerow([f"'{cell}" if cell[:1] in ("=", "+", "@") else cell for cell in row])
    print(f"written to {file}")


def _replay_of_many(options: Options, recording: Path, out: Path) -> Figures:
    alone = options if options.parquet is None else replace(options, parquet=out / TABLE)
    return figures(_replay_one(alone, recording, out, timed=False))
