# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints and maps with something wrong in them."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from live_world import DESCRIPTORS, PATIENCE, SECOND, World

from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.landmarks import Map, map_rows
from rs_localizer.ros.node.conversion import make_message


def landmarks(world: World, frame: str = "map") -> Map:
    """What all frames of the recording show, with a descriptor for each number."""
    tables = [
        np.unique(world.table_of(cloud)[["id", "x", "y", "z"]]) for cloud in world.recording.clouds
    ]
    table = np.unique(np.concatenate(tables))
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    return Map(points, table["id"].astype(np.int64), DESCRIPTORS[table["id"]], frame)


def map_message(
    world: World, change: Callable[[np.ndarray], np.ndarray] = lambda rows: rows, frame: str = "map"
) -> Any:
    rows = change(map_rows(landmarks(world, frame)))
    return "map_points", make_cloud(make_message, 0, frame, rows)


def keypoints(world: World, count: int = 0, **columns: np.ndarray) -> Any:
    """Those of a good frame, with other marks; repeated up to a count."""
    table = world.table()
    marks = columns or {"descriptor": DESCRIPTORS[table["id"]]}
    kinds = [("u", "<f4"), ("v", "<f4")]
    kinds += [(name, mark.dtype, mark.shape[1:]) for name, mark in marks.items()]
    rows = np.zeros(len(table), kinds)
    for name, values in {"u": table["u"], "v": table["v"], **marks}.items():
        rows[name] = values
    rows = np.resize(rows, count or len(rows))
    world.stamp += SECOND // 30
    return "keypoints", make_cloud(make_message, world.stamp, "camera", rows)


def marked(**columns: Any) -> Callable[[World], Any]:
    """Keypoints with these marks, made of the ids of a good frame."""
    return lambda world: [
        keypoints(world, **{name: mark(world.table()["id"]) for name, mark in columns.items()})
    ]


def mapped(change: Callable[[np.ndarray], np.ndarray], **attributes: Any) -> Callable[[World], Any]:
    def do(world: World) -> Any:
        topic, message = map_message(world, change)
        for name, value in attributes.items():
            setattr(message, name, value)
        return [(topic, message)]

    return do


def without_a_map(world: World) -> str:
    """Keypoints come, a map does not."""
    before = len(world.said)
    world.send(world.recording.info)
    world.wait(lambda: world.send(keypoints(world)) or len(world.said) > before)
    assert world.diagnosis("State = waiting for a map")
    return "; ".join(world.said[before:])


def late_map(world: World) -> str:
    assert not world.poses(keypoints(world), within=0.3)
    world.send(map_message(world))
    world.wait(lambda: world.poses(keypoints(world), within=0.3))
    return "localized since the map came"


def replaced_within_a_frame(world: World) -> str:
    """The frame that is worked on is answered by the old map, the next one by the new."""
    frames = world.node._localizer
    localize = frames.localize_keypoints
    started, go_on = threading.Event(), threading.Event()

    def wait(message: Any) -> Any:
        del frames.localize_keypoints
        started.set()
        assert go_on.wait(PATIENCE)
        return localize(message)

    frames.localize_keypoints = wait
    before = len(world.peer.poses)
    world.wait(lambda: world.send(keypoints(world)) or started.wait(0.1))
    world.send(map_message(world, frame="hall"))
    world.wait(lambda: "map_points" in world.node.worker._mailbox._updates)
    go_on.set()
    world.wait(lambda: len(world.peer.poses) > before)
    assert world.peer.poses[before].header.frame_id == "map"
    world.wait(lambda: world.poses(keypoints(world), within=0.3))
    assert world.peer.poses[-1].header.frame_id == "hall"
    world.send(map_message(world))
    world.wait(
        lambda: (
            world.poses(keypoints(world), within=0.3)
            and world.peer.poses[-1].header.frame_id == "map"
        )
    )
    return next(text for text in world.said if text.startswith("map_replaced"))


def repeated(rows: np.ndarray) -> np.ndarray:
    rows["id"][1] = rows["id"][0]
    return rows
