# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes the first part of ``docs/reasons.md`` from the names that ``replay`` explains.

    python docs/make_reasons.py

What follows there is written by hand, and kept.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path

from rs_localizer.core.reasons import SETTINGS, ImuReason, Reason

REASONS_PAGE = Path(__file__).with_name("reasons.md")
_REASONS_INTRODUCTION = """\
# Reasons, notices and states, and what to do

## Why a frame has no pose

`Failure.reason` of the library; in `replay`, the log and `/diagnostics`. In italics: what to check.
*Settings*: {settings}.

"""
_IMU_INTRODUCTION = """
## Why the IMU is not used for an image

The image still has its pose, by the camera alone: [imu.md](imu.md).

"""
_BY_HAND = "\n<!-- From here on written by hand"


def reasons_page() -> str:
    """The page of the reasons, with the part that is written by hand as it stands."""
    written = REASONS_PAGE.read_text(encoding="utf-8")
    by_hand = written[written.index(_BY_HAND) :]
    introduction = _REASONS_INTRODUCTION.format(settings=SETTINGS)
    tables = introduction + _rows(Reason) + _IMU_INTRODUCTION + _rows(ImuReason)
    return tables + by_hand


def _rows(reasons: Iterable[Reason | ImuReason]) -> str:
    said = (f"* `{it}`: {it.means}; *{it.look_at.replace(SETTINGS, 'settings')}*" for it in reasons)
    return "".join(f"{textwrap.fill(line, 100, subsequent_indent='  ')}\n" for line in said)


if __name__ == "__main__":
    REASONS_PAGE.write_text(reasons_page(), encoding="utf-8")
