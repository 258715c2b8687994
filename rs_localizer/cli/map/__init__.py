# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: describe maps, and make them from recordings and from other maps."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rs_localizer.tools.readout_belief import ReadoutCheck


def check_readout(readout: ReadoutCheck | None, camera: str = "") -> None:
    """Refuse a map that is made with the wrong readout time.

    It is bent by many times what its deviations say, and fits its images nearly as well.

    Args:
        camera: of a rig, whose readout time it is.

    Raises:
        ValueError: with the readout time that the images show.
    """
    if readout is not None and readout.differs:
        whose = f"{camera}: " if camera else ""
        instead = "calibrate --rig finds it" if camera else "-p readout_time:=0.0 estimates it"
        raise ValueError(f"{whose}{readout.message}; {instead}")
