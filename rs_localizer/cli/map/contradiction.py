# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What becomes of a map whose images contradict the readout time that was given."""

from __future__ import annotations

import argparse

from rs_localizer.cli import WORKING

if WORKING:
    from rs_localizer.mapping.readout_check import ReadoutCheck

_KEEP = "--keep-readout-time"


def add_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        _KEEP,
        action="store_true",
        help="write the map even where the images show another readout time than was given",
    )


def check(
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
