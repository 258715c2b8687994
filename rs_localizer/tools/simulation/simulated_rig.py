# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of several cameras on one body, each with a clock of its own."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.rigs import RigParts, node_parameters
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.tools.simulation.renderer import RenderedFrame
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame, frame_stamps
from rs_localizer.tools.simulation.simulated_recording import view_messages, write_truth
from rs_localizer.tools.simulation.true_motion import TrueMotion, TrueState

# Relative error of the rates of cameras' oscillators: common quartz.
_RATE_ERROR = 5e-5
# The random numbers of clocks are their own.
_CLOCK_STREAM = 28

Frame = SimulatedFrame | RenderedFrame

RIG_FRAME = "rig"


def optical_frame(name: str) -> str:
    """Return the frame of a camera of a rig."""
    return f"{name}_optical_frame"


def make_mounts(parts: RigParts) -> Any:
    """Return a tf2_msgs/TFMessage that says where the cameras are on the rig."""
    transforms = [
        make_transform(
            make_message, 0, RIG_FRAME, optical_frame(name),
            Transform(*parts.camera_from_rig[name]).inverse(),
        )
        for name in parts.cameras
    ]  # fmt: skip
    return make_message("tf2_msgs/msg/TFMessage", transforms=transforms)


@dataclass(frozen=True, slots=True, eq=False)
class MountedMotion:
    """The motion of a camera on a moving rig: ``X_camera = rotation X_rig + translation``."""

    rig: TrueMotion
    rotation: Array  # (3,3)
    translation: Array  # (3,) m

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return self.rig.intervals_ns

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        rig = self.rig.state(stamp_ns, offsets)
        centre = -self.rotation.T @ self.translation
        return TrueState(
            rig.rotations @ self.rotation.T,
            rig.positions + rig.rotations @ centre,
            rig.angular @ self.rotation.T,
            (rig.linear + np.cross(rig.angular, centre)) @ self.rotation.T,
        )


@dataclass(frozen=True, slots=True, eq=False)
class RigFrame:
    """Images of one of the cameras in a frame of the rig."""

    name: str
    stamp_ns: int  # by the camera's own clock
    frame: Frame


def camera_stamps(
    parts: RigParts, motion: TrueMotion, rate: float, seed: int
) -> dict[str, list[int]]:
    """Return the times (ns, true) at which the first rows of each camera are exposed.

    Each camera runs freely, at any phase, with a rate that is off by some parts in a hundred
    thousand.
    """
    stamps = {}
    for place, (name, camera) in enumerate(parts.cameras.items()):
        rng = np.random.default_rng([seed, _CLOCK_STREAM, place])
        phase, error = rng.uniform(0.0, 1.0 / rate), rng.normal(0.0, _RATE_ERROR)
        steady = np.array(frame_stamps(motion, camera, rate * (1.0 + error)), np.int64)
        shifted = steady + round(phase * 1e9)
        lasts_ns = round(camera.readout_time * 1e9)
        stamps[name] = [
            int(stamp)
            for stamp in shifted
            if any(first <= stamp <= last - lasts_ns for first, last in motion.intervals_ns)
        ]
    return stamps


def simulate_rig(
    parts: RigParts, motion: TrueMotion, see: Callable[[str, TrueMotion, int], Iterable[Frame]]
) -> Iterator[RigFrame]:
    """Return the frames of all cameras, in the order in which they have been read.

    Args:
        parts: the rig; its stamps are those of true time without ``time_offset``.
        motion: of the rig's axes.
        see: the frames of a camera by its name, its motion, and its place among the random numbers.
    """

    def images(place: int, name: str, camera: Camera) -> Iterator[tuple[int, int, RigFrame]]:
        mounted = MountedMotion(motion, *parts.camera_from_rig[name])
        offset_ns = round(parts.time_offset.get(name, 0.0) * 1e9)
        for frame in see(name, mounted, 1000 * place):
            read_ns = frame.stamp_ns + round(camera.readout_time * 1e9)
            yield read_ns, place, RigFrame(name, frame.stamp_ns - offset_ns, frame)

    streams = [images(place, *item) for place, item in enumerate(parts.cameras.items())]
    for _, _, image in heapq.merge(*streams, key=lambda item: item[:2]):
        yield image


def rig_parameters(parts: RigParts) -> dict[str, Any]:
    """Return the node's parameters for a recording of the rig."""
    return {**node_parameters(parts), "base_frame": RIG_FRAME}


def write_rig_frame(
    bag: BagWriter,
    parts: RigParts,
    motion: TrueMotion,
    image: RigFrame,
    keypoints: NDArray[Any] | None = None,
) -> None:
    """Write camera info and content of a camera, and the rig's truth.

    The truth is of when its first and its middle row were exposed.
    """
    camera, frame, stamp_ns = parts.cameras[image.name], image.frame, image.stamp_ns
    recorded_ns = frame.stamp_ns + round(camera.readout_time * 1e9)
    for time_ns in sorted({frame.stamp_ns, frame.middle_ns}):
        write_truth(bag, time_ns, motion.state(time_ns, np.zeros(1)), RIG_FRAME, recorded_ns)
    messages = view_messages(camera, frame, stamp_ns, keypoints, optical_frame(image.name))
    for topic, message in messages.items():
        bag.write(f"/{image.name}{topic}", message, recorded_ns)
