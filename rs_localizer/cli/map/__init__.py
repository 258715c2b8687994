# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what a map holds, and maps made from recordings and from other maps."""

from __future__ import annotations

import argparse
import importlib

from rs_localizer.cli import LateParser, add_common

# Each module offers ``add_arguments(parser)`` and ``run(arguments)``.
ACTIONS = {
    "build": "make a map from images",
    "info": "describe a map",
    "convert": "write a map to another file",
    "align": "bring a map to metres, to z up, to an origin",
    "survey": "find where markers are, from a recording that shows them",
    "refine": "adjust a map with the rolling shutter that saw it",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(
        dest="action", required=True, metavar="ACTION", parser_class=LateParser
    )
    for name, summary in ACTIONS.items():
        action = actions.add_parser(name, help=summary, allow_abbrev=False)
        add_common(action)
        action.come_from(f"{__name__}.{name}")


def run(args: argparse.Namespace) -> object:
    return importlib.import_module(f"{__name__}.{args.action}").run(args)
