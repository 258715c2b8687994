# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Two free-running cameras at one live node: ``python -m benchmarks.load.rig --faults``.

Both are moved by hand through a room, one upside down beside the other; their images are published
in real time from this process, which hears the poses. ``--faults``: 15 s after the beginning the
second camera stops for 2 s; from 25, 35 and 45 s on its clock is 20 ms and 0.3 s ahead and 5 s
behind. The exit code is 1 if an image has no pose and the node does not say why.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message

from benchmarks.hand_held import CAMERA, hand_motion
from benchmarks.load.measuring import cpu_time, running
from rs_localizer.cli.options import integer, number
from rs_localizer.core.arrays import Array
from rs_localizer.io import topics
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import make_camera_info, make_correspondences
from rs_localizer.io.rigs import RIG_FRAME, RigParts, optical_frame
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.ros.node.conversion import copy_message, make_message, message_class
from rs_localizer.ros.node.inputs import Intake, NotByExecutor
from rs_localizer.settings import NODE_NAME, write_parameters
from rs_localizer.tools.simulation.frames import SimulatedFrame, simulate_frames
from rs_localizer.tools.simulation.rig import camera_stamps, rig_parameters, simulate_rig
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import TrueMotion, sampled_states

_UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0])
_PARTS = RigParts(
    {"left": CAMERA, "right": CAMERA},
    {"left": (np.eye(3), np.zeros(3)), "right": (_UPSIDE_DOWN, np.array([0.1, 0.0, 0.0]))},
    {},
)
_RATE = 30.0  # Hz
_PROCESSING = 0.015  # s, from the last row to the correspondences
# s from the beginning: what happens to the second camera's clock (s), or None while it has stopped.
_FAULTS = ((15.0, None), (17.0, 0.0), (25.0, 0.02), (35.0, 0.3), (45.0, -5.0))
_SETTLING = 2.0  # s after a fault whose poses count apart
_CONNECTING, _REST = 3.0, 1.5  # s


class Sent(NamedTuple):
    """An image that has been published."""

    name: str
    true_ns: int  # of its first row
    at: float  # s, time.monotonic()


@dataclass(slots=True)
class Heard:
    """What the node says."""

    poses: list[tuple[float, bytes]] = field(default_factory=list)  # time.monotonic(), message
    values: dict[str, str] = field(default_factory=dict)  # of the last diagnosis
    messages: list[tuple[float, str]] = field(default_factory=list)  # changes of its message

    def diagnosis(self, message: DiagnosticArray) -> None:
        """Take a message of the diagnostics."""
        for status in message.status:
            if status.name.endswith(f"{NODE_NAME}: localizer"):
                self.values = {item.key: item.value for item in status.values}
                if not self.messages or self.messages[-1][1] != status.message:
                    self.messages.append((time.monotonic(), status.message))


def _listen(node: Node, prefix: str, heard: Heard) -> Intake:
    """Hear poses as they come, without an executor, which would be part of the latency."""
    pose, status = f"{prefix}/{NODE_NAME}/{topics.POSE}", topics.DIAGNOSTICS
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    listeners = [
        node.create_subscription(
            kind, topic, take, QoSProfile(depth=50), callback_group=NotByExecutor(),
            event_callbacks=silent, raw=raw,
        )
        for kind, topic, take, raw in (
            (PoseStamped, pose, lambda it: heard.poses.append((time.monotonic(), it)), True),
            (DiagnosticArray, status, heard.diagnosis, False),
        )
    ]  # fmt: skip
    return Intake(node.context, listeners, sys.exit)


def _clock(seconds: float, faults: bool) -> float | None:
    """By how much (s) the second camera's clock is ahead; None: it has stopped."""
    states = [state for start, state in _FAULTS if seconds >= start]
    return states[-1] if faults and states else 0.0


def _publish(node: Node, prefix: str, images: list[Any], faults: bool) -> list[Sent]:
    """Send the images of both cameras, each when it has been read and processed."""
    mounts = [
        make_transform(make_message, 0, RIG_FRAME, optical_frame(name), Transform(*mount).inverse())
        for name, mount in _PARTS.camera_from_rig.items()
    ]
    tf2_ros = importlib.import_module("tf2_ros")  # which not every machine has
    broadcaster = tf2_ros.StaticTransformBroadcaster(node)
    broadcaster.sendTransform(mounts)
    publishers = {
        (name, topic): node.create_publisher(
            message_class(kind), f"{prefix}/{name}/{topic}", qos_profile_sensor_data
        )
        for name in _PARTS.cameras
        for topic, kind in (
            (topics.CAMERA_INFO, "sensor_msgs/msg/CameraInfo"),
            (topics.CORRESPONDENCES, "sensor_msgs/msg/PointCloud2"),
        )
    }
    infos = {
        name: copy_message(info, info.__msgtype__)
        for name, camera in _PARTS.cameras.items()
        for info in (make_camera_info(camera, 0, optical_frame(name)),)
    }
    deadline = time.monotonic() + _CONNECTING
    while time.monotonic() < deadline:
        for name, info in infos.items():
            publishers[name, topics.CAMERA_INFO].publish(info)
        time.sleep(0.1)
    sent, begin, first_ns = [], time.monotonic() + 0.1, images[0].frame.stamp_ns
    read = round((CAMERA.readout_time + _PROCESSING) * 1e9)
    for image in images:
        true_ns = image.frame.stamp_ns
        ahead = _clock(1e-9 * (true_ns - first_ns), faults) if image.name == "right" else 0.0
        if ahead is None:
            continue
        frame = image.frame
        stamp = image.stamp_ns + round(1e9 * ahead)
        cloud = make_correspondences(stamp, frame.points, frame.pixels, frame.ids)
        message = serialize_message(copy_message(cloud, cloud.__msgtype__))
        left = begin + 1e-9 * (true_ns + read - first_ns) - time.monotonic()
        time.sleep(max(left, 0.0))
        publishers[image.name, topics.CAMERA_INFO].publish(infos[image.name])
        sent.append(Sent(image.name, true_ns, time.monotonic()))
        publishers[image.name, topics.CORRESPONDENCES].publish(message)
    time.sleep(_REST)
    return sent


def _report(heard: Heard, sent: list[Sent], motion: TrueMotion, faults: bool) -> int:
    """Print what came of the images; how many of the first camera's nobody accounts for."""
    first, second = ([it for it in sent if it.name == name] for name in _PARTS.cameras)
    answered = {}
    for at, serialized in heard.poses:
        pose = deserialize_message(serialized, PoseStamped)
        answered[stamp_ns(pose)] = at, pose.pose.position
    times = np.array([it.true_ns for it in second])
    latencies, errors, seconds = [], [], []
    for image in first:
        if image.true_ns not in answered:
            continue
        at, place = answered[image.true_ns]
        partner = second[int(np.abs(times - image.true_ns).argmin())]
        is_near = abs(partner.true_ns - image.true_ns) < 0.5e9 / _RATE and partner.at < at
        latencies.append(at - max(image.at, partner.at if is_near else image.at))
        true = motion.state(image.true_ns, np.zeros(1)).positions[0]
        errors.append(np.linalg.norm([place.x, place.y, place.z] - true))
        seconds.append(1e-9 * (image.true_ns - sent[0].true_ns))
    values = heard.values
    lost = len(first) - len(latencies)
    print(
        f"{len(first)} + {len(second)} images, {len(heard.poses)} poses, {lost} images of the "
        f"first camera without one; the node: {values.get('Frames received')} received, "
        f"{values.get('Frames replaced')} replaced, {values.get('Frames refused')} refused\n"
        f"  latency {_percentiles(1e3 * np.array(latencies))} ms from the image that completes a "
        f"frame; position off by {_percentiles(1e3 * np.array(errors))} mm"
    )
    for start, state in _FAULTS if faults else ():
        said = [text for at, text in heard.messages if 0.0 < at - sent[0].at - start < 8.0]
        after = np.array(seconds) - start
        near = (after >= 0.0) & (after < _SETTLING)
        expected = sum(
            0.0 <= 1e-9 * (it.true_ns - sent[0].true_ns) - start < _SETTLING for it in first
        )
        if not near.any():
            print(f"  at {start:.0f} s: no pose of {expected} images")
            continue
        what = "stops" if state is None else f"clock {1e3 * state:+.0f} ms"
        print(
            f"  at {start:.0f} s, {what}: {near.sum()} poses of {expected} images in "
            f"{_SETTLING:g} s, off by {_percentiles(1e3 * np.array(errors)[near])} mm; said: "
            f"{' | '.join(said) or 'nothing'}"
        )
    for name in ("Clock offset of right (ms)", "Extrinsics of right off by"):
        print(f"  {name}: {values.get(name)}")
    return lost - int(values.get("Frames replaced", 0)) - int(values.get("Frames refused", 0))


def _percentiles(values: Array) -> str:
    """Median, 95 % and most."""
    return " / ".join(f"{value:.1f}" for value in np.percentile(values, (50, 95, 100)))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load.rig", description=__doc__)
    parser.add_argument("--minutes", type=number(0.05), default=1.0)
    parser.add_argument("--points", type=integer(12), default=200, help="of each image")
    parser.add_argument("--outliers", type=number(0.0, 0.9), default=0.3, help="share of them")
    parser.add_argument("--faults", action="store_true", help="see above")
    args = parser.parse_args()
    motion = hand_motion()
    world = room(sampled_states(motion).positions, np.random.default_rng(0), count=20_000)
    settings = FrameSettings(args.points, 0.7, args.outliers, _RATE)
    stamps = {
        name: of[: round(60.0 * args.minutes * _RATE)]
        for name, of in camera_stamps(_PARTS, motion, _RATE, seed=4).items()
    }

    def see(name: str, mounted: TrueMotion, seed: int) -> Iterator[SimulatedFrame]:
        return simulate_frames(CAMERA, mounted, world, settings, stamps_ns=stamps[name], seed=seed)

    images = list(simulate_rig(_PARTS, motion, see))
    heard = Heard()
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "rig.yaml"
        write_parameters(file, rig_parameters(_PARTS) | {"rig.estimate_time_offsets": args.faults})
        with running(1, "--params-file", str(file)) as (peer, [(namespace, pid)]):
            intake = _listen(peer, namespace, heard)
            before, start = cpu_time(pid), time.monotonic()
            sent = _publish(peer, namespace, images, args.faults)
            used = (cpu_time(pid) - before) / (time.monotonic() - start)
            intake.close()
    lost = _report(heard, sent, motion, args.faults)
    print(f"  CPU {used:.0%} of a core; unaccounted for: {lost}")
    return 0 if lost <= 0 else 1


if __name__ == "__main__":
    sys.exit(main())
