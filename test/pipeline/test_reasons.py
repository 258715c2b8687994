# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every reason for refusing a frame is explained to users, and none that does not exist."""

import re
from pathlib import Path

import rs_localizer
from rs_localizer.core.reasons import ImuReason, Reason
from rs_localizer.pipeline.reasons import IMU_REASONS, REASONS, explained

PACKAGE = Path(rs_localizer.__file__).parent


def test_every_reason_is_explained_and_given_somewhere():
    assert set(REASONS) == set(Reason)
    others = (path for path in PACKAGE.rglob("*.py") if path.name != "reasons.py")
    given = {name for path in others for name in re.findall(r"\bReason\.(\w+)", path.read_text())}
    assert {reason.name for reason in Reason} == given


def test_a_reason_says_what_it_means_and_what_to_look_at():
    text = explained("degenerate")
    assert "do not determine the motion" in text
    assert "look at it from an angle" in text
    assert explained("unheard_of") == ""


def test_every_reason_to_go_without_the_imu_has_its_sentence():
    assert set(IMU_REASONS) == set(ImuReason)
    assert not set(IMU_REASONS) & set(REASONS)
    assert "which message belongs to which row" in explained(ImuReason.NO_READOUT_TIME)
