"""The IMU of ``map build``: that of the bag, or a file beside a video or a folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.io.bags import is_bag, open_bag
from rs_localizer.io.imu_files import read_imu_csv
from rs_localizer.io.topics import IMU
from rs_localizer.mapping.inertial_placing import GivenImu
from rs_localizer.offline.imu_recording import optical_frame, read_imu_recording
from rs_localizer.offline.recordings import RecordingError
from rs_localizer.offline.replay import imu_topics
from rs_localizer.trajectory.imu import ImuRecording


def add_imu_arguments(group: argparse._ArgumentGroup) -> None:
    """Options that :func:`imu_of` reads."""
    group.add_argument(
        "--imu",
        nargs="?",
        const="",
        metavar="TOPIC|FILE.csv",
        help="the IMU that went along: no map without its scale. A topic of the bag (default: the "
        "only one; used without this option, too, if it gives a scale); beside a video or a folder "
        "a file as EuRoC's imu0/data.csv, with the clock of the images",
    )
    group.add_argument("--no-imu", action="store_true", help="without that of the bag")


def imu_of(args: argparse.Namespace) -> GivenImu | None:
    """The IMU, where there is one.

    Raises:
        UsageError: for options that do not go together.
        ValueError: when one that is asked for cannot be read.
    """
    if args.imu is not None and args.no_imu:
        raise UsageError("give --imu or --no-imu, not both")
    if args.no_imu:
        return None
    if is_bag(args.images):
        return _of_bag(args)
    if args.imu is None:
        return None
    if not args.imu:
        raise UsageError("a video or folder has no IMU of its own: give --imu FILE.csv")
    stamps, rates, forces = read_imu_csv(Path(args.imu))
    return GivenImu(ImuRecording(stamps, rates, specific_forces=forces), asked=True)


def _of_bag(args: argparse.Namespace) -> GivenImu | None:
    with open_bag(args.images) as bag:
        topics = imu_topics(bag)
        named = [topic for topic in topics if topic.split("/")[-1] == IMU]
        found = named if len(named) == 1 else topics
        if args.imu is None and len(found) != 1:
            if found:
                print(f"no IMU is used: choose {' or '.join(found)} with --imu")
            return None
        topic = args.imu or (found[0] if len(found) == 1 else None)
        frame = optical_frame(bag, args.camera_info, args.image)
        try:
            return GivenImu(read_imu_recording(bag, topic, frame), asked=args.imu is not None)
        except RecordingError as error:
            if args.imu is not None:
                raise
            print(f"no IMU is used: {error}")
            return None
