# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what a map holds, and maps made from recordings and from other maps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from rs_localizer.cli import WORKING
from rs_localizer.cli.options import option

if WORKING:
    from rs_localizer.tools.readout_belief import ReadoutCheck

print_step = partial(print, "adjusted:", flush=True)
"""What an adjustment calls after each of its steps."""


@dataclass(frozen=True, kw_only=True)
class ReadoutOptions:
    """the readout time."""

    keep_readout_time: bool = option(
        "write the map even where the images show another readout time than was given",
        default=False,
    )


def check_readout(
    options: Any, readout: ReadoutCheck | None, instead: str, camera: str = ""
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
    if not options.keep_readout_time:
        raise ValueError(
            f"{fault}; {instead}, and with --keep-readout-time it is written all the same"
        )
    print(f"warning: {fault}")
