"""The node's settings as options of a command: ``--params FILE`` and ``-p NAME:=VALUE``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.config import NodeConfig
from rs_localizer.settings import build, load_params_file, parse_assignment


def add_settings(parser: argparse.ArgumentParser, which: str) -> None:
    """Both options; ``which`` names the settings that matter."""
    parser.add_argument("--params", type=Path, metavar="FILE", help="settings: ROS 2 params file")
    parser.add_argument(
        "-p",
        dest="assignments",
        action="append",
        default=[],
        metavar="NAME:=VALUE",
        help=f"one setting: {which}",
    )


def settings_of(args: argparse.Namespace) -> NodeConfig:
    """What was given; raises UsageError for settings that cannot be."""
    try:
        values = {} if args.params is None else load_params_file(args.params)
        return build(values | dict(map(parse_assignment, args.assignments)))
    except ValueError as error:
        raise UsageError(str(error)) from error
