# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames, their truth, and rigs of cameras as messages of a recording."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import make_header, make_quaternion, make_vector
from rs_localizer.io.recording import (
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    CORRESPONDENCES_TOPIC,
    KEYPOINTS_TOPIC,
    MAP_FRAME,
    RAW_IMAGE_TOPIC,
    make_camera_info,
    make_correspondences,
    make_image,
)
from rs_localizer.io.rigs import RigParts
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.tools.simulation.renderer import FORMAT, RenderedFrame
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame, frame_stamps
from rs_localizer.tools.simulation.true_motion import TrueMotion, TrueState

# Share of the bits that differ between two views of a landmark; ORB's median is about this.
BIT_ERRORS = 0.1


def random_descriptors(count: int, rng: np.random.Generator, width: int = 32) -> NDArray[np.uint8]:
    """Return the binary descriptors (count,width) without anything in common."""
    return rng.integers(0, 256, (count, width), dtype=np.uint8)


def keypoint_rows(frame: SimulatedFrame, landmarks: Map, rng: np.random.Generator) -> NDArray[Any]:
    """Return rows (n,) of a cloud of keypoints: pixels, ids or binary descriptors of landmarks.

    Outliers of the frame have the mark of a landmark and the pixel of something else, as wrong
    matches do.
    """
    kinds: list[tuple[Any, ...]] = [("u", "<f4"), ("v", "<f4")]
    if landmarks.ids is not None:
        kinds.append(("id", landmarks.id_type))
    if (descriptors := landmarks.descriptors) is not None:
        kinds.append(("descriptor", descriptors.dtype, descriptors.shape[1:]))
    rows = np.empty(len(frame.ids), kinds)
    rows["u"], rows["v"] = frame.pixels.T
    if landmarks.ids is not None:
        rows["id"] = landmarks.ids[frame.ids]
    if descriptors is not None:
        flips = rng.random((len(frame.ids), 8 * descriptors.shape[1])) < BIT_ERRORS
        rows["descriptor"] = np.bitwise_xor(descriptors[frame.ids], np.packbits(flips, axis=1))
    return rows


TRUE_POSE_TOPIC = "/truth/pose"
TRUE_TWIST_TOPIC = "/truth/twist"


def write_simulated(
    bag: BagWriter, camera: Camera, frame: SimulatedFrame | RenderedFrame,
    keypoints: NDArray[Any] | None = None, later_ns: int = 0,
) -> None:  # fmt: skip
    """Write what a camera sees, and the truth at first and middle row.

    Args:
        later_ns: from the time of a message to when it is recorded.
    """
    for topic, message in view_messages(camera, frame, frame.stamp_ns, keypoints).items():
        bag.write(topic, message, frame.stamp_ns + later_ns)
    truths = {frame.stamp_ns: frame.first_row, frame.middle_ns: frame.middle_row}
    for time_ns, state in truths.items():
        write_truth(bag, time_ns, state, CAMERA_FRAME, time_ns + later_ns)


def view_messages(
    camera: Camera, frame: SimulatedFrame | RenderedFrame, stamp_ns: int,
    keypoints: NDArray[Any] | None = None, optical: str = CAMERA_FRAME,
) -> dict[str, Any]:  # fmt: skip
    """Return camera info, and image, keypoints or correspondences, by topic.

    Args:
        stamp_ns: by the camera's own clock.
        keypoints: instead of correspondences.
        optical: frame of the camera.
    """
    if isinstance(frame, RenderedFrame):
        topic, message = RAW_IMAGE_TOPIC, make_image(stamp_ns, FORMAT, frame.data, optical)
    elif keypoints is None:
        topic = CORRESPONDENCES_TOPIC
        message = make_correspondences(stamp_ns, frame.points, frame.pixels, frame.ids)
    else:
        topic, message = KEYPOINTS_TOPIC, make_cloud(make_message, stamp_ns, optical, keypoints)
    return {CAMERA_INFO_TOPIC: make_camera_info(camera, stamp_ns, optical), topic: message}


def write_truth(
    bag: BagWriter, stamp_ns: int, state: TrueState, body: str, recorded_ns: int
) -> None:
    """Write pose and twist of a body in the map, recorded at its time or another."""
    pose = make_message(
        "geometry_msgs/msg/Pose",
        position=make_vector(make_message, state.positions[0], "Point"),
        orientation=make_quaternion(make_message, state.rotations[0]),
    )
    linear, angular = (make_vector(make_message, of[0]) for of in (state.linear, state.angular))
    twist = make_message("geometry_msgs/msg/Twist", linear=linear, angular=angular)
    for topic, kind, frame, name, value in (
        (TRUE_POSE_TOPIC, "PoseStamped", MAP_FRAME, "pose", pose),
        (TRUE_TWIST_TOPIC, "TwistStamped", body, "twist", twist),
    ):
        header = make_header(make_message, stamp_ns, frame)
        message = make_message(f"geometry_msgs/msg/{kind}", **{"header": header, name: value})
        bag.write(topic, message, recorded_ns)


# Relative error of the rates of cameras' oscillators: common quartz.
_RATE_ERROR = 5e-5
# The random numbers of clocks are their own.
_CLOCK_STREAM = 28

Frame = SimulatedFrame | RenderedFrame

RIG_FRAME = "rig"


def make_mounts(parts: RigParts) -> Any:
    """Return a tf2_msgs/TFMessage that says where the cameras are on the rig."""
    transforms = [
        make_transform(
            make_message, 0, RIG_FRAME, f"{name}_optical_frame",
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
        own = rate * (1.0 + error)
        stamps[name] = frame_stamps(motion, camera, own, round(phase * 1e9))
    return stamps


def simulate_rig(
    parts: RigParts, motion: TrueMotion, see: Callable[[str, TrueMotion, int], Iterable[Frame]]
) -> Iterator[RigFrame]:
    """Yield the frames of one camera after the other; readers of a bag order them by time.

    Args:
        parts: the rig; its stamps are those of true time without ``time_offset``.
        motion: of the rig's axes.
        see: the frames of a camera by its name, its motion, and its place among the random numbers.
    """
    for place, name in enumerate(parts.cameras):
        mounted = MountedMotion(motion, *parts.camera_from_rig[name])
        offset_ns = round(parts.time_offset.get(name, 0.0) * 1e9)
        for frame in see(name, mounted, 1000 * place):
            yield RigFrame(name, frame.stamp_ns - offset_ns, frame)


def write_rig_frame(
    bag: BagWriter, parts: RigParts, motion: TrueMotion, image: RigFrame,
    keypoints: NDArray[Any] | None = None,
) -> None:  # fmt: skip
    """Write camera info and content of a camera, and the rig's truth.

    The truth is of when its first and its middle row were exposed.
    """
    camera, frame, stamp_ns = parts.cameras[image.name], image.frame, image.stamp_ns
    recorded_ns = frame.stamp_ns + round(camera.readout_time * 1e9)
    for time_ns in sorted({frame.stamp_ns, frame.middle_ns}):
        write_truth(bag, time_ns, motion.state(time_ns, np.zeros(1)), RIG_FRAME, recorded_ns)
    optical = f"{image.name}_optical_frame"
    messages = view_messages(camera, frame, stamp_ns, keypoints, optical)
    for topic, message in messages.items():
        bag.write(f"/{image.name}{topic}", message, recorded_ns)
