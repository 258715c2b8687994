# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Offline, a frame waits until the recording has its readings, and nothing changes its place."""

from collections.abc import Callable

from rs_localizer.offline.replay import Item, imu_first

MS = 1_000_000


def played(items: list[Item], needs: Callable[[str], int], imu: str | None = "imu") -> list[str]:
    """Messages as they come out; a frame needs a reading so many ms after its own time."""
    newest, out = -1, []

    def awaits(item: Item) -> bool:
        return item[0] == "frame" and newest < item[1] + needs(item[2]) * MS

    for topic, recorded_ns, message in imu_first(items, imu, awaits):
        if topic == "imu":
            newest = recorded_ns
        else:
            out.append(message)
        out += [message] if topic == "imu" else []
    return out


def recording() -> list[Item]:
    readings = [("imu", 10 * i * MS, f"r{i}") for i in range(12)]
    frames = [("frame", (25 + 30 * i) * MS, f"f{i}") for i in range(3)]
    infos = [("info", (24 + 30 * i) * MS, f"i{i}") for i in range(3)]
    return sorted([*readings, *frames, *infos], key=lambda item: item[1])


def test_a_frame_comes_when_its_readings_have():
    out = played(recording(), lambda name: 10)
    assert [name for name in out if name[0] != "r"] == ["i0", "f0", "i1", "f1", "i2", "f2"]
    assert out.index("f0") == out.index("r4") + 1  # 35 ms lie between r3 and r4
    assert out.index("i1") > out.index("f0")
    assert [name for name in out if name[0] == "r"] == [f"r{i}" for i in range(12)]


def test_a_frame_whose_readings_never_come_goes_on():
    items = recording()
    assert played(items, lambda name: 10_000)[-5:] == ["f0", "i1", "f1", "i2", "f2"]  # at its end
    late = [*items, ("info", 1100 * MS, "last"), ("imu", 1200 * MS, "r")]
    out = played(late, lambda name: 10_000)
    assert out.index("f2") < out.index("last")
    assert out[-1] == "r"


def test_without_an_imu_nothing_waits():
    items = [item for item in recording() if item[0] != "imu"]
    assert played(items, lambda name: 10_000, imu=None) == [item[2] for item in items]
