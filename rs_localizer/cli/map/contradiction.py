"""What becomes of a map whose images contradict the readout time that was given."""

from __future__ import annotations

import argparse

from rs_localizer.mapping.asked_readout import AskedReadout

_KEEP = "--keep-readout-time"


def add_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        _KEEP,
        action="store_true",
        help="write the map even where the images ask for another readout time than was given",
    )


def check(args: argparse.Namespace, asked: AskedReadout | None, instead: str) -> None:
    """Refuse a map that is made with the wrong readout time: it is bent by many times what its
    deviations say, and fits its images nearly as well.

    Args:
        instead: what else the user can do.

    Raises:
        ValueError: unless the user wants it all the same.
    """
    if asked is None or not asked.differs:
        return
    if not args.keep_readout_time:
        raise ValueError(f"{asked.told}; {instead}, and with {_KEEP} it is written all the same")
    print(f"warning: {asked.told}")
