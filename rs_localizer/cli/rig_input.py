# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cameras of a rig: which recording and topics are whose, and how they are mounted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from rs_localizer.cli import WORKING
from rs_localizer.cli.image_input import LensOptions
from rs_localizer.cli.options import UsageError

if WORKING:
    from rs_localizer.config import NodeConfig
    from rs_localizer.io.bags import is_bag, open_bag
    from rs_localizer.offline.recordings import optical_frame
    from rs_localizer.offline.replay import camera_topics


T = TypeVar("T", bound=LensOptions)


def check_there(recordings: Sequence[Path]) -> None:
    """Raise ValueError for one that does not exist, before any other has been read."""
    for path in recordings:
        if not path.exists():
            raise ValueError(f"{path} does not exist")


def cameras_of(args: T, recordings: Sequence[Path], config: NodeConfig) -> dict[str, tuple[T, str]]:
    """Return the cameras of one bag, or of a recording of each, by name.

    Of each: the options of a recording of this camera alone, and the frame of its optical axes.
    """
    found: list[tuple[str, dict[str, Any], str]]
    if len(recordings) > 1:
        found = [
            (re.sub(r"\W", "_", path.stem, flags=re.ASCII), {"recording": path}, "")
            for path in recordings
        ]
    else:
        found = _in_one_bag(recordings[0], config.cameras if config.of_cameras else None)
    names = [name for name, _, _ in found]
    if len(set(names)) < max(len(names), 2) or not all(name[:1].isalpha() for name in names):
        raise UsageError(
            f"--rig: cameras need different names that begin with a letter: {', '.join(names)}"
        )
    check_there(recordings)
    # Single recordings that were put together have one frame.
    differ = len({frame for _, _, frame in found}) == len(found)
    cameras, lens = {}, args.calibration
    for name, own, frame in found:
        calibration = None if lens is None else lens.with_name(f"{lens.name}#{name}")
        alone = replace(args, **own, calibration=calibration)
        cameras[name] = alone, (differ and frame) or f"{name}_optical_frame"
    return cameras


def _in_one_bag(path: Path, given: Sequence[str] | None) -> list[tuple[str, dict[str, Any], str]]:
    """Return name, topics as options, and frame of each camera of a bag."""
    if not is_bag(path):
        raise UsageError(f"--rig needs the recordings of several cameras, or one bag; got {path}")
    with open_bag(path) as bag:
        return [
            (
                name,
                {"recording": path, "remaps": [f"{it}:={topic}" for it, topic in own.items()]},
                optical_frame(bag, own["camera_info"]),
            )
            for name, own in camera_topics(bag, given).items()
        ]
