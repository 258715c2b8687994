"""Arguments of commands that take images, and what is told of them beside the result."""

from __future__ import annotations

import argparse
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path

from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import is_bag
from rs_localizer.io.calibration.files import CALIBRATION_KINDS
from rs_localizer.io.image_clock import DEFAULT_START_NS, ImageClock, readout_fault
from rs_localizer.io.recording import PARAMETERS
from rs_localizer.process.arguments import number
from rs_localizer.settings import settings, write_parameters


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """The camera and the topics of a bag."""
    camera = parser.add_argument_group("the camera")
    camera.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help=f"{CALIBRATION_KINDS} (default: the bag's camera_info)",
    )
    longest = settings()["readout_time"].maximum or 0.0
    camera.add_argument(
        "--readout-time",
        type=number(0.0, longest),
        metavar="S",
        help=f"seconds from the first row to the last: written to {PARAMETERS} beside the data, "
        f"for replay --params (default: as in {PARAMETERS} of the bag)",
    )
    camera.add_argument(
        "--scan-direction",
        choices=[direction.value for direction in ScanDirection],
        help=f"likewise (default: {ScanDirection.TOP_TO_BOTTOM})",
    )
    camera.add_argument(
        "--rate",
        type=number(0.0, above=True),
        metavar="HZ",
        help="images per second, instead of the presentation times of a video, or for files whose "
        "names are not times in ns",
    )
    camera.add_argument(
        "--start",
        type=number(0.0),
        metavar="S",
        help="time of the first image of a video or folder (default: "
        f"{DEFAULT_START_NS * 1e-9:g}, since ROS takes 0 for none; of names that are times, their "
        "own)",
    )
    bag = parser.add_argument_group("topics of a bag (default: the only ones of their types)")
    bag.add_argument("--image", metavar="TOPIC")
    bag.add_argument("--camera-info", metavar="TOPIC")


def write_shutter(args: argparse.Namespace, out: Path) -> None:
    """The shutter: as given, or as simulate writes it beside the images of a recording."""
    beside = args.images / PARAMETERS
    if args.readout_time is not None:
        direction = args.scan_direction or ScanDirection.TOP_TO_BOTTOM.value
        write_parameters(out / PARAMETERS, args.readout_time, direction)
    elif is_bag(args.images) and beside.exists():
        shutil.copy(beside, out / PARAMETERS)


def tell_left_out(refused: Mapping[str, str], carried: Mapping[str, int]) -> None:
    """Images that could not be read, and other messages that are kept."""
    for detail in refused.values():
        print(f"images that cannot be read are left out, the first one because {detail}")
    if carried:
        kept = ", ".join(f"{topic} ({count})" for topic, count in carried.items())
        print(f"kept for replay: {kept}")


def time_faults(args: argparse.Namespace, clock: ImageClock | None, period: float) -> list[str]:
    """Say where the times are from; what speaks against them, and against the readout time.

    Args:
        period: s from one image to the next.
    """
    faults = []
    if clock is not None:
        print(clock.told())
        faults.append(clock.fault())
    if args.readout_time is not None:
        faults.append(readout_fault(args.readout_time, period))
    return [fault for fault in faults if fault]


def tell_next(args: argparse.Namespace, more: str = "") -> None:
    """The command that makes poses of the recording, with further options."""
    out = shlex.quote(str(args.out))
    with_parameters = (args.out / PARAMETERS).exists()
    shutter = f"--params {out}/{PARAMETERS}" if with_parameters else "-p readout_time:=SECONDS"
    poses = shlex.quote(f"{args.out}_poses")
    print(f"next: rs_localizer replay {out} {shutter}{more} --out {poses}")
