"""``rs_localizer replay --rerun`` and ``--view``: what was found, for the Rerun viewer."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.cli.fleet import is_fleet
from rs_localizer.cli.replay_result import VIEW
from rs_localizer.cli.replay_summary import Tally
from rs_localizer.io.bags import BagReader
from rs_localizer.offline.replay import Topics
from rs_localizer.offline.viewing.stream import check_screen, write_view
from rs_localizer.pipeline.frames import FrameLocalizer

_SUFFIX = ".rrd"
# Known by being this very object: a user's view.rrd is in the current directory, as any other name.
_BESIDE_POSES = Path(VIEW)


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to look at the result."""
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


def check_view(args: argparse.Namespace) -> None:
    """Refuse what cannot be shown before there is anything to show.

    Raises:
        UsageError: for options that do not go together.
        ValueError: without the Rerun SDK or, for the viewer, a screen.
    """
    if args.rerun is None and not args.view:
        return
    if is_fleet(args) or args.ros:
        raise UsageError("--rerun and --view show one recording, replayed offline")
    if args.rerun is not None and args.rerun.suffix != _SUFFIX:
        raise UsageError(
            f"--rerun FILE must end in {_SUFFIX}, got {args.rerun} (a recording stands before it)"
        )
    if importlib.util.find_spec("rerun") is None:
        raise ValueError(
            "--rerun and --view need the Rerun SDK, which is not installed: "
            "pip install 'rs_localizer[view]'"
        )
    if args.view:
        check_screen()


def write_file(
    args: argparse.Namespace,
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    tally: Tally,
    out: Path,
) -> Path | None:
    """Write what ``--rerun`` asks for; of no pose there is nothing to be seen."""
    if args.rerun is None or not tally.frames:
        return None
    file: Path = out / VIEW if args.rerun is _BESIDE_POSES else args.rerun
    write_view(bag, topics, localizer, tally.written, file)
    return file


def open_viewer(
    args: argparse.Namespace,
    bag: BagReader,
    topics: Topics,
    localizer: FrameLocalizer,
    tally: Tally,
) -> None:
    """Open the viewer if ``--view`` asks for it; the result is there, whether it starts or not."""
    if args.view and tally.frames:
        write_view(bag, topics, localizer, tally.written, None)
