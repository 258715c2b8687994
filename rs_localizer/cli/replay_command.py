# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay``: a recording -> poses and twists, at full speed and without ROS."""

from __future__ import annotations

import functools
import importlib
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tqdm import tqdm

from rs_localizer.cli import detect_command, earlier_result, refuse_existing
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.recording_input import ImageOptions, given_topics, given_values
from rs_localizer.config import ImuUse, NodeConfig
from rs_localizer.features.extraction import kind_of
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import is_bag, open_bag
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.recording import BRIDGED, CAMERA, MAP, MAP_FRAME, PARAMETERS, RESULT
from rs_localizer.io.topics import IMU
from rs_localizer.io.trajectories import POSES_FILE, TWISTS_FILE
from rs_localizer.markers.map_files import is_marker_file
from rs_localizer.offline import fleet, frame_table, tasks
from rs_localizer.offline.image_sources import holds_images, image_topics
from rs_localizer.offline.replay import has_frames, imu_topics, prepare_replay
from rs_localizer.offline.results import Smooth, Tally, figures, summary, write_results
from rs_localizer.offline.tasks import Figures, Outcome, Task
from rs_localizer.settings import build

# The table of each of many recordings.
TABLE = "frames.parquet"


@dataclass(frozen=True, kw_only=True)
class Options(ImageOptions, ResultOptions):
    recordings: list[Path] = argument(
        "rosbag2 (MCAP, sqlite3) or ROS 1 bag; with --map, a video, a folder or a bag of images",
        "RECORDING",
    )
    out: Path | None = option(
        f"directory to create, for {POSES_FILE} (TUM), {TWISTS_FILE} and the bag {RESULT}; of "
        "many, one for all (default: RECORDING_replay)", "DIR",
    )  # fmt: skip
    map: Path | None = option(
        "the map of the keypoints; of images, also markers or the result of map build, which "
        "brings the lens and the shutter", "FILE",
    )  # fmt: skip
    smooth: bool = option(
        "one motion through all images, from those before and after each; images without a pose "
        f"are bridged where their neighbours determine them, and listed in {BRIDGED}",
        default=False,
    )
    pose_rate: float | None = option(
        "with --smooth: poses of the motion per second (default: one for each image)",
        "HZ", above=0.0,
    )  # fmt: skip
    parquet: Path | None = option(
        "also write one table of all recordings, a row a frame: poses, twists, covariances, why "
        "frames were refused (pip install 'rs_localizer[table]')", "FILE",
    )  # fmt: skip
    workers: int | None = option(
        "recordings at a time, each in a process of its own (pip install 'rs_localizer[fleet]')",
        "N", least=1,
    )  # fmt: skip
    scheduler: str | None = option(
        "instead: the workers of a Dask scheduler, such as tcp://host:8786, which see these files",
        "ADDRESS",
    )


def run(options: Options) -> Figures | None:
    if (table := options.parquet) is not None:
        frame_table.schema()  # what is not installed is said now
        if table.is_file() or not table.exists():  # else it takes all that comes: /dev/stdout
            refuse_existing(options, table)
    if options.pose_rate is not None and not options.smooth:
        raise UsageError("--pose-rate goes with --smooth")
    if len(options.recordings) > 1 or options.workers or options.scheduler:
        _replay_all(options)
        return None
    recording = options.recordings[0]
    out = options.out or Path(f"{recording.resolve().with_suffix('').name}_replay")
    return {"out": str(out)} | figures(_replay_one(options, recording, out))


def _settings(options: Options) -> NodeConfig:
    files = {"map_file": options.map, "camera_file": options.calibration}
    given = {name: str(file) for name, file in files.items() if file is not None}
    return build(given_values(options) | given)


def _replay_one(options: Options, recording: Path, out: Path, timed: bool = True) -> Tally:
    """Replay a recording into ``out``, and say what came of it (``timed``: how fast, too)."""
    pictures = ""  # of a recording without matches, as ``is a video``
    if not is_bag(recording):
        pictures = holds_images(recording)
    else:
        with open_bag(recording) as bag:
            pictures = "holds images" if image_topics(bag) and not has_frames(bag) else ""
    if not pictures:
        if options.rate is not None:
            raise UsageError("--rate is of images without times; poses at a rate are --pose-rate")
        return _replay_matches(options, recording, recording, out, timed)
    if options.map is None:
        lens = "" if is_bag(recording) else ", and --camera, as calibrate writes it"
        raise ValueError(
            f"{recording} {pictures}, not matches: give --map, of markers or landmarks{lens}"
        )
    with TemporaryDirectory() as place:
        matches = Path(place) / "matches"
        of_images = _detection(options, recording, options.map, matches)
        detect_command.detect(of_images)
        # The given settings are in the file beside the matches now, with those of the video.
        own = matches / PARAMETERS
        alone = replace(
            options, params=own if own.exists() else None, assignments=[], rate=None,
            map=_map_file(options.map) if of_images.features else None, remaps=[],
            calibration=None,
        )  # fmt: skip
        return _replay_matches(alone, matches, recording, out, timed)


def _detection(options: Options, recording: Path, place: Path, out: Path) -> detect_command.Options:
    """Return the options of ``detect`` that find the matches of images with the map ``place``."""
    by_markers = is_marker_file(place)
    calibration, params = options.calibration, options.params
    if (place / MAP).is_file():  # a result of map build; a bag has a lens of its own
        if is_bag(recording):
            params = params or place / CAMERA
        else:
            calibration = calibration or place / CAMERA
    return detect_command.Options(
        recording=recording, out=out, map=place if by_markers else None,
        features=None if by_markers else kind_of(read_map_file(_map_file(place), MAP_FRAME)),
        calibration=calibration, params=params, assignments=options.assignments,
        remaps=options.remaps, rate=options.rate,
    )  # fmt: skip


def _map_file(place: Path) -> Path:
    """Return the file of the landmarks, also in a result of map build."""
    return place / MAP if (place / MAP).is_file() else place


def _replay_matches(options: Options, path: Path, recording: Path, out: Path, timed: bool) -> Tally:
    """Replay the bag ``path``, whose images or matches are those of ``recording``."""
    config = _settings(options)
    notices: dict[str, tuple[int, str]] = {}

    def notice(name: str, text: str) -> None:
        notices[name] = notices.get(name, (0, ""))[0] + 1, text

    if config.of_cameras and options.parquet is not None:
        raise UsageError("--parquet is for one camera: leave it out with cameras")
    with open_bag(path) as bag:
        topics, localizer = prepare_replay(bag, config, given_topics(options), notice)
        unused = IMU not in topics.of and config.imu.use != ImuUse.NONE
        if unused and (several := imu_topics(bag)):
            print(f"no IMU is used: choose {' or '.join(several)} with -r imu:=TOPIC")
        if options.smooth and config.readout_time == 0.0 and not config.of_cameras:
            raise ValueError("--smooth needs the readout time: -p readout_time:=SECONDS")
        tally = Tally(bag.count([topics.frames]), notices)
        if options.parquet is not None:
            tally.table = frame_table.FrameTable(recording, localizer, options.smooth)
        # Other files of the user stay.
        names = POSES_FILE, TWISTS_FILE, BRIDGED, RESULT, tasks.MARKER, tasks.LOG
        earlier = earlier_result(options, f"{RESULT}/metadata.yaml", out, names)
        with (
            atomic_directory(out, earlier) as built,
            # The bar is for a person who waits: none in a log file.
            tqdm(total=tally.total, unit="frame", desc="replay", disable=None) as bar,
        ):
            built.mkdir()
            own = (path if path.is_dir() else path.parent) / PARAMETERS
            if options.params is None and own.is_file():
                print(f"the recording has settings of its own: --params {shlex.quote(str(own))}")
            smooth: Smooth | None = None
            if options.smooth:
                from rs_localizer.tools.smoothing import smooth_frames  # with SciPy

                smooth = functools.partial(smooth_frames, localizer, rate=options.pose_rate)
            tally.done = bar.update
            write_results(bag, topics, localizer, tally, built, smooth)
        print(*summary(tally, config, out, timed), sep="\n")
        if tally.table is not None and options.parquet is not None:
            print(frame_table.write_parquet([tally.table.table()], options.parquet))
        if not tally.localized:
            raise ValueError(
                f"no frame of {recording} was localized; of the last one, {tally.last_refusal}"
            )
    return tally


def _replay_all(options: Options) -> None:
    """Replay many recordings, each into a folder of its own, except those that are complete."""
    out = options.out
    if out is None:
        raise UsageError("many recordings need --out DIR, for a folder of each")
    if options.workers is not None and options.scheduler is not None:
        raise UsageError("--workers are of this machine; give it or --scheduler")
    if options.scheduler or options.workers:
        importlib.import_module("distributed")  # what is not installed is said now
    config = _settings(options)  # refuses wrong ones before there are workers
    if options.map is None and config.map_file:  # where it is from here, not from a worker
        options = replace(options, map=Path(config.map_file))
    params, landmarks, lens = files = [
        None if place is None else place.absolute()
        for place in (options.params, options.map, options.calibration)
    ]
    own = replace(
        options, recordings=[], out=None, overwrite=False, workers=None, scheduler=None,
        params=params, map=landmarks, calibration=lens,
        parquet=None if options.parquet is None else Path(TABLE),
    )  # fmt: skip
    changed = [file.stat().st_mtime_ns for file in files if file is not None]
    work = functools.partial(_replay_of_many, own)
    every = tasks.tasks_of(options.recordings, out.absolute(), work, repr((own, changed)))
    if not options.overwrite:
        tasks.refuse_others(every)
    left = sum(tasks.finished(task) is None for task in every)
    print(f"{len(every) - left} of {len(every)} recordings have been done before")
    with tqdm(total=left, unit="recording", disable=None) as bar:

        def heard(task: Task, outcome: Outcome) -> None:
            bar.update()
            bar.write(f"{task.folder.name}: {outcome if isinstance(outcome, str) else 'done'}")

        outcomes = fleet.do_all(every, out, options.scheduler, options.workers, heard)
    print(f"written to {out / tasks.SUMMARY}")
    done = [task for task in every if not isinstance(outcomes[task.folder], str)]
    if options.parquet is not None:
        from pyarrow.parquet import read_table

        tables = [read_table(task.folder / TABLE) for task in done]
        print(frame_table.write_parquet(tables, options.parquet))
    if failed := len(every) - len(done):
        raise ValueError(
            f"{failed} of {len(every)} recordings failed; {out / tasks.SUMMARY} says why"
        )


def _replay_of_many(options: Options, recording: Path, out: Path) -> Figures:
    alone = options if options.parquet is None else replace(options, parquet=out / TABLE)
    return figures(_replay_one(alone, recording, out, timed=False))
