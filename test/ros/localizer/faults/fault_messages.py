# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Clouds and camera_infos with something wrong in them."""

import resource
from collections.abc import Callable
from typing import Any

import numpy as np
from live_world import SECOND, World
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointField


def info(**changes: Any) -> Callable[[World], Any]:
    return lambda world: [world.info(**changes)]


def cloud(**changes: Any) -> Callable[[World], Any]:
    return lambda world: [world.cloud(**changes)]


def fields(*change: Any, **attributes: Any) -> Callable[[World], Any]:
    """A cloud whose first fields are these, or the fifth one (v) with other attributes."""

    def do(world: World) -> Any:
        found = [
            PointField(name=i.name, offset=i.offset, datatype=i.datatype, count=i.count)
            for i in world.recording.clouds[0].fields
        ]
        for name, value in attributes.items():
            setattr(found[4], name, value)
        return [world.cloud(fields=[*change, *found])]

    return do


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[World], Any]:
    """A cloud whose table is changed."""
    return lambda world: [world.cloud_of(change(world.table()))]


def stamped(*seconds: float) -> Callable[[World], Any]:
    """Frames with these stamps, one after the other; each is to be localized."""

    def do(world: World) -> str:
        before = len(world.said)
        for second in seconds:
            message = world.cloud()
            world.stamp = round(second * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(world.stamp, SECOND)
            # On a busy machine the pose of a frame before may come first.
            assert any(
                world.poses(message, within=1.0)
                and world.peer.poses[-1].header.stamp == message.header.stamp
                for _ in range(20)
            )
        return "; ".join(world.said[before:])

    return do


def big_endian(world: World) -> Any:
    table = world.table()
    swapped = table.astype(table.dtype.newbyteorder(">"))
    return [world.cloud(is_bigendian=True, data=swapped.tobytes())]


def many(world: World) -> str:
    """A million points, each with its own noise.

    Noise that ten thousand share would be taken for acceleration: with so many no prior counts.
    """
    table = np.resize(world.table_of(world.recording.exact), 1_000_000)
    rng = np.random.default_rng(3)
    for name in "uv":
        table[name] += rng.normal(0.0, 0.5, len(table))
    world.send(world.recording.info)
    # 24 MB come in hundreds of pieces, of which a busy machine easily loses one.
    assert any(world.poses(world.cloud_of(table), within=4.0) for _ in range(30))
    return ""


def noise(count: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(table: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(1)
        table = np.resize(table, count)
        table["u"], table["v"] = rng.uniform(0, 640, count), rng.uniform(0, 480, count)
        return table

    return change


def resized(world: World) -> Any:
    """The camera switches to twice the size, in the middle of the stream, and back."""
    assert world.poses(world.cloud())
    scale = np.array([2, 1, 2, 1, 2, 2, 1, 1, 1])
    offset = np.array([0, 0, 0.5, 0, 0, 0.5, 0, 0, 0])
    large = world.info(width=1280, height=960, k=scale * np.array(world.recording.info.k) + offset)
    table = world.table()
    for name in "uv":
        table[name] = 2.0 * table[name] + 0.5
    world.send(large)
    world.wait(lambda: world.node._localizer.calibration.width == 1280)
    return [world.cloud_of(table)]


def garbage(world: World) -> str:
    """Messages whose every field may be anything."""
    rng = np.random.default_rng(2)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sizes = [0, 1, 2, 7, 100, 2**16, 2**31, 2**32 - 1]
    source = world.recording
    for number in range(10_000):
        if number % 4 == 0:
            good = source.info
            changes: dict[str, Any] = {
                "width": int(rng.choice(sizes)),
                "height": int(rng.choice(sizes)),
                "k": rng.choice([0.0, 1.0, -1.0, 500.0, 1e300, np.nan, np.inf], 9),
                "d": rng.choice([0.0, 1.0, np.nan, -1e300], rng.integers(0, 15)),
                "distortion_model": str(rng.choice(["plumb_bob", "equidistant", "", "x\0y"])),
                "binning_x": int(rng.choice(sizes)),
            }
        else:
            good = source.clouds[0]
            changes = {
                "width": int(rng.choice(sizes)),
                "height": int(rng.choice(sizes)),
                "point_step": int(rng.choice(sizes)),
                "row_step": int(rng.choice(sizes)),
                "is_bigendian": bool(rng.integers(2)),
                "data": rng.bytes(int(rng.integers(0, 3000))),
                "fields": [
                    PointField(
                        name=str(rng.choice([*"xyzuv", "score", "id", "", "\u00e4"])),
                        offset=int(rng.choice(sizes)),
                        datatype=int(rng.integers(0, 256)),
                        count=int(rng.choice(sizes)),
                    )
                    for _ in range(rng.integers(0, 9))
                ],
            }
        kept = {name: changes[name] for name in changes if rng.random() < 0.4}
        kinds = good.get_fields_and_field_types()
        message = type(good)(**({name: getattr(good, name) for name in kinds} | kept))
        if not kept:
            continue
        # Past DDS, which drops what comes faster than the node takes it.
        topic = "camera_info" if number % 4 == 0 else "correspondences"
        subscription = world.node._inputs._subscriptions[topic]
        subscription.callback(serialize_message(message) if subscription.raw else message)
        if number % 20 == 0:
            world.wait(lambda: not world.node.worker._mailbox._frames)
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert growth < 50_000, f"{growth} kB more memory"
    assert "internal_error" not in world.node.refusals.counts
    return f"{sum(world.node.refusals.counts.values())} refused"
