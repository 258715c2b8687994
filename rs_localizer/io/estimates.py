# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses and twists from whatever holds them: text files, recordings, outputs of replay."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.io.bags import SUFFIXES, BagError, BagReader, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.trajectories import Trajectory, Twists, read_tum, read_twists

POSES_FILE, TWISTS_FILE = "poses.txt", "twists.txt"
"""What replay calls its text files."""

_POSE, _TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Poses, and twists where there are any."""

    poses: Trajectory
    twists: Twists | None


def read_motions(
    path: Path, pose_topic: str | None = None, twist_topic: str | None = None
) -> Motions:
    """Poses and twists of a TUM file, a directory made by replay, or a recording.

    Args:
        pose_topic, twist_topic: where a recording has them; default: its only PoseStamped or
            TwistStamped.

    Raises:
        ValueError: when there are none, naming the path and what was found.
    """
    if (path / POSES_FILE).is_file():
        twists = path / TWISTS_FILE
        has_twists = twists.is_file() and any(
            not line.startswith("#") for line in twists.read_text(encoding="utf-8").splitlines()
        )
        return Motions(read_tum(path / POSES_FILE), read_twists(twists) if has_twists else None)
    if path.is_file() and path.suffix not in SUFFIXES:
        return Motions(read_tum(path), None)
    with open_bag(path) as bag:
        pose_topic = _topic(bag, _POSE, pose_topic, "--pose-topic", required=True)
        twist_topic = _topic(bag, _TWIST, twist_topic, "--twist-topic", required=False)
        messages = _by_stamp(bag, pose_topic)
        poses = Trajectory(
            np.array(list(messages), np.int64),
            np.array([_xyz(m.pose.position) for m in messages.values()]),
            np.array([_xyzw(m.pose.orientation) for m in messages.values()]),
        )
        if twist_topic is None:
            return Motions(poses, None)
        messages = _by_stamp(bag, twist_topic)
        return Motions(
            poses,
            Twists(
                np.array(list(messages), np.int64),
                np.array([_xyz(m.twist.angular) for m in messages.values()]),
                np.array([_xyz(m.twist.linear) for m in messages.values()]),
            ),
        )


def _topic(
    bag: BagReader, type_name: str, chosen: str | None, option: str, *, required: bool
) -> Any:
    candidates = sorted(topic for topic, kind in bag.topics.items() if kind == type_name)
    if chosen is not None:
        if chosen not in candidates:
            raise BagError(_sentence(bag, f"no {type_name} on {chosen}", candidates))
        return chosen
    if len(candidates) > 1:
        raise BagError(_sentence(bag, f"several {type_name}; choose with {option}", candidates))
    if required and not candidates:
        raise BagError(_sentence(bag, f"no {type_name}", bag.topics))
    return candidates[0] if candidates else None


def _sentence(bag: BagReader, fault: str, topics: Collection[str]) -> str:
    return f"{bag.path} has {fault}; found {', '.join(sorted(topics)) or 'none'}"


def _by_stamp(bag: BagReader, topic: str) -> dict[int, Any]:
    """Messages in the order of their stamps, one for each."""
    messages = {stamp_ns(message): message for _, _, message in bag.messages([topic])}
    return dict(sorted(messages.items()))


def _xyz(vector: Any) -> list[float]:
    return [float(vector.x), float(vector.y), float(vector.z)]


def _xyzw(quaternion: Any) -> list[float]:
    return [*_xyz(quaternion), float(quaternion.w)]
