# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the method as options of the judges: ``--params FILE``, ``-p NAME:=VALUE``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_localizer.cli.settings_args import given_settings
from rs_localizer.config import NodeConfig


def add_settings(parser: argparse.ArgumentParser) -> None:
    """The options, for :func:`settings_of`."""
    parser.add_argument("--params", type=Path, metavar="FILE", help="settings: a ROS 2 params file")
    parser.add_argument(
        "-p", dest="assignments", action="append", default=[], metavar="NAME:=VALUE",
        help="one setting; may be repeated",
    )  # fmt: skip


def settings_of(args: argparse.Namespace) -> NodeConfig:
    """What they say."""
    return given_settings(args)
