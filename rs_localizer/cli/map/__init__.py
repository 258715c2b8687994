# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: describe maps, and make them from recordings and from other maps."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rs_localizer.tools.readout_belief import ReadoutCheck


def check_readout(readout: ReadoutCheck | None) -> None:
    """Refuse a map that is made with the wrong readout time.

    It is bent by many times what its deviations say, and fits its images nearly as well.

    Raises:
        ValueError: with the readout time that the images show.
    """
    if readout is not None and readout.differs:
        raise ValueError(f"{readout.message}; -p readout_time:=0.0 estimates it")
