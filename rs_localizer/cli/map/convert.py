"""``rs_localizer map convert``: other files of the same map."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.cli.map import info
from rs_localizer.io.maps.files import WRITERS
from rs_localizer.io.maps.ply import write_ply
from rs_localizer.io.whole import whole_files


def add_arguments(parser: argparse.ArgumentParser) -> None:
    info.add_arguments(parser)
    parser.add_argument("out", type=Path, metavar="OUT", help=" or ".join(WRITERS))
    parser.add_argument("--text", action="store_true", help="write .ply as text")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT")


def run(args: argparse.Namespace) -> None:
    _check_usage(args)
    landmarks = info.read_and_describe(args)
    with whole_files(args.out):
        if args.text:
            write_ply(args.out, landmarks, binary=False)
        else:
            WRITERS[args.out.suffix](args.out, landmarks)
    print(f"written to {args.out}")


def _check_usage(args: argparse.Namespace) -> None:
    if args.out.suffix not in WRITERS:
        raise UsageError(f"OUT must end in {' or '.join(WRITERS)}, got {args.out}")
    if args.text and args.out.suffix != ".ply":
        raise UsageError("--text goes with .ply")
    if args.out.exists() and not args.overwrite:
        raise ValueError(f"{args.out} exists; choose another OUT, or --overwrite")
