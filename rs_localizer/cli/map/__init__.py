# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what a map holds, and maps made from recordings and from other maps."""

from __future__ import annotations

import argparse
import importlib
from functools import partial

from rs_localizer.cli import WORKING, LateParser, add_common

if WORKING:
    from rs_localizer.tools.mapping.observations import ReadoutCheck

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


print_step = partial(print, "adjusted:", flush=True)
"""What an adjustment calls after each of its steps."""

_KEEP = "--keep-readout-time"


def add_readout_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        _KEEP,
        action="store_true",
        help="write the map even where the images show another readout time than was given",
    )


def check_readout(
    args: argparse.Namespace, readout: ReadoutCheck | None, instead: str, camera: str = ""
) -> None:
    """Refuse a map that is made with the wrong readout time.

    It is bent by many times what its deviations say, and fits its images nearly as well.

    Args:
        instead: what else the user can do.
        camera: of a rig, whose readout time it is.

    Raises:
        ValueError: unless the user wants it all the same.
    """
    if readout is None or not readout.differs:
        return
    fault = f"{camera}: {readout.message}" if camera else readout.message
    if not args.keep_readout_time:
        raise ValueError(f"{fault}; {instead}, and with {_KEEP} it is written all the same")
    print(f"warning: {fault}")
