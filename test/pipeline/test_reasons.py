"""Every reason for refusing a frame is explained to users, and none that does not exist."""

from __future__ import annotations

import re
from pathlib import Path

import rs_localizer
from rs_localizer.core.types import Reason
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.pipeline.reasons import IMU_REASONS, REASONS, ImuReason, explained

PACKAGE = Path(rs_localizer.__file__).parent
# Of single images, which detect and marker_detector tell of themselves.
OF_IMAGES = {"bad_image", "no_time"}


def test_the_table_is_that_of_the_code() -> None:
    used = {str(reason) for reason in Reason}
    for path in PACKAGE.rglob("*.py"):
        used |= set(re.findall(r"Refusal\(\s*\"(\w+)\"", path.read_text()))
    used |= {item.refused for item in INPUTS.values()}
    used |= set(
        re.findall(r"NO_TRANSFORM = \"(\w+)\"", (PACKAGE / "pipeline" / "published.py").read_text())
    )
    assert set(REASONS) == used - OF_IMAGES


def test_a_reason_says_what_it_means_and_what_to_look_at() -> None:
    text = explained("degenerate")
    assert "do not determine the motion" in text
    assert "look at it from an angle" in text
    assert explained("unheard_of") == ""


def test_every_reason_to_go_without_the_imu_has_its_sentence() -> None:
    assert set(IMU_REASONS) == set(ImuReason)
    assert not set(IMU_REASONS) & set(REASONS)
    assert "which message belongs to which row" in explained(ImuReason.NO_READOUT_TIME)
