# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer watch``: how a live localizer node is, on a terminal."""

from __future__ import annotations

import argparse
import re
import sys

from rs_localizer.cli import import_ros, number
from rs_localizer.settings import NODE_NAME

# As ROS has it for topics, which begin with the name of the node.
_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*/?", re.ASCII)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "node",
        nargs="?",
        type=_node,
        default=f"/{NODE_NAME}",
        metavar="NODE",
        help="the localizer, with its namespace (default: %(default)s)",
    )
    parser.add_argument(
        "--every",
        type=number(0.05),
        metavar="S",
        help="seconds from one look to the next (default: 0.2 on a terminal, else 1)",
    )


def _node(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise argparse.ArgumentTypeError(
            f"must be a node's name, such as /front/{NODE_NAME}, got {text!r}"
        )
    return text


def run(args: argparse.Namespace) -> None:
    """Write until Ctrl-C.

    Raises:
        ValueError: without ROS.
    """
    import_ros("watch", "watch").watch(args.node, sys.stdout, args.every)
