# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what a map holds, and maps made from recordings and from other maps."""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType

# Each module offers ``add_arguments(parser)`` and ``run(arguments)``. All are imported for the
# help: what only its work needs is imported late.
ACTIONS = {
    "build": "make a map from images",
    "info": "describe a map",
    "convert": "write a map to another file",
    "align": "bring a map to metres, to z up, to an origin",
    "survey": "find where markers are, from a recording that shows them",
    "refine": "adjust a map with the rolling shutter that saw it",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    for name, summary in ACTIONS.items():
        action = actions.add_parser(name, help=summary, allow_abbrev=False)
        _module(name).add_arguments(action)


def run(args: argparse.Namespace) -> object:
    return _module(args.action).run(args)


def _module(action: str) -> ModuleType:
    return importlib.import_module(f"{__name__}.{action}")
