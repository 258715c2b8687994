# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every image of a rendered recording through both live nodes, held against replay's result.

    python -m benchmarks.image_flight flight poses -p pose_time:=mid_frame

``flight`` is what ``simulate --images`` wrote, ``poses`` what ``replay`` made of its markers with
the same parameters. Each image is sent when the one before has been answered, so that none is
dropped: then the nodes have to say the same, bit for bit.

    python -m benchmarks.image_flight flight poses -p pose_time:=mid_frame --map map.npz

does so by features and a map of landmarks, of which ``detect --features sift`` and ``replay --map``
made ``poses``.

    python -m benchmarks.image_flight flight --rate 30

sends the images at a camera's pace instead, and tells how long the poses take.
"""

from __future__ import annotations

import argparse
import bisect
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from tqdm import tqdm

from rs_localizer.io import topics
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import (
    CAMERA_INFO_TOPIC,
    CORRESPONDENCES_TOPIC,
    KEYPOINTS_TOPIC,
    MARKER_MAP,
    PARAMETERS,
    RAW_IMAGE_TOPIC,
)
from rs_localizer.ros.node.conversion import copy_message
from rs_localizer.settings import NODE_NAME

POSE, TWIST = f"/{NODE_NAME}/{topics.POSE}", f"/{NODE_NAME}/{topics.TWIST}"
KINDS = {POSE: PoseStamped, TWIST: TwistStamped}
_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
# The nodes' inputs are best effort, and a busy machine loses messages: here, none may be lost.
_RELIABLE = "qos_overrides.{}.subscription.reliability:=reliable"
_START_TIMEOUT = 300.0  # s, of a machine that compiles for the first time
_ANSWER_TIMEOUT = 30.0
# Nodes that have found this process may still have to find each other (s).
_ACQUAINTANCE = 1.0
_STOP_TIMEOUT = 20.0
_LAST_ANSWERS = 1.0


@contextmanager
def flying(images: Path, parameters: list[str], landmarks: Path | None = None) -> Iterator[Flight]:
    """Both nodes, started and ready, until the end.

    Args:
        images: directory with the bag, the parameters and, for markers, their map.
        parameters: further ones of the localizer.
        landmarks: map file; the localizer gets keypoints of the feature detector and matches them
            with it. None: markers are looked for.
    """
    given = [word for parameter in parameters for word in ("-p", parameter)]
    detector, topic = "marker_detector", CORRESPONDENCES_TOPIC
    markers = ["-p", f"marker_map:={images / MARKER_MAP}"]
    if landmarks is not None:
        detector, topic, markers = "feature_detector", KEYPOINTS_TOPIC, []
        given += ["-p", f"map_file:={landmarks}"]
    processes = {
        detector: _start(
            detector,
            *markers,
            *("-r", f"{topics.IMAGE}:={RAW_IMAGE_TOPIC.removesuffix('/compressed')}"),
            *("-r", f"{topics.COMPRESSED_IMAGE}:={RAW_IMAGE_TOPIC}"),
            *("-p", _RELIABLE.format(RAW_IMAGE_TOPIC)),
        ),
        "localizer": _start(
            "main",
            *("--params-file", str(images / PARAMETERS)),
            *("-p", _RELIABLE.format(topic)),
            *("-p", _RELIABLE.format(CAMERA_INFO_TOPIC)),
            *given,
        ),
    }
    context = Context()
    rclpy.init(args=[], context=context)
    try:
        flight = Flight(context, processes, topic)
        flight.wait_for_nodes()
        yield flight
    finally:
        rclpy.shutdown(context=context)
        for process in processes.values():
            process.terminate()
        for process in processes.values():
            process.wait(_STOP_TIMEOUT)


def _start(function: str, *arguments: str) -> subprocess.Popen[bytes]:
    code = f"import sys; from rs_localizer.ros.main import {function}; sys.exit({function}())"
    return subprocess.Popen([sys.executable, "-c", code, "--ros-args", *arguments])


class Flight:
    """Publishes images and hears the answers."""

    def __init__(
        self, context: Context, processes: Mapping[str, subprocess.Popen[bytes]], topic: str
    ) -> None:
        self._processes = processes
        self._node = rclpy.create_node("image_flight", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._images = self._node.create_publisher(CompressedImage, RAW_IMAGE_TOPIC, _QOS)
        self._infos = self._node.create_publisher(CameraInfo, CAMERA_INFO_TOPIC, _QOS)
        self._detected: set[int] = set()
        self.heard: dict[str, dict[int, Any]] = {topic: {} for topic in KINDS}
        self.arrivals: dict[int, float] = {}  # of poses, time.monotonic() by stamp
        for answer, kind in KINDS.items():
            self._node.create_subscription(kind, answer, self._listener(self.heard[answer]), _QOS)
        self._node.create_subscription(
            PointCloud2, topic, lambda m: self._detected.add(stamp_ns(m)), _QOS
        )

    def _listener(self, heard: dict[int, Any]) -> Callable[[Any], None]:
        def hear(message: Any) -> None:
            if heard is self.heard[POSE]:
                self.arrivals[stamp_ns(message)] = time.monotonic()
            heard[stamp_ns(message)] = message

        return hear

    def wait_for_nodes(self) -> None:
        self._wait(
            lambda: (
                self._images.get_subscription_count()
                and self._infos.get_subscription_count()
                and self._node.count_publishers(POSE)
            ),
            _START_TIMEOUT,
            "the nodes do not listen",
        )
        self._wait_until(time.monotonic() + _ACQUAINTANCE)

    def send(self, images: Path, offline: Mapping[str, Mapping[int, Any]]) -> int:
        """All images of a bag; the answers that replay has are waited for."""
        count = 0
        with open_bag(images) as bag:
            total = bag.count([RAW_IMAGE_TOPIC])
            stamps = [stamp for _, stamp, _ in bag.messages([RAW_IMAGE_TOPIC])]
            # A pose belongs to the last image before it.
            poses = {stamps[bisect.bisect_right(stamps, p) - 1]: p for p in offline[POSE]}
            with tqdm(total=total, unit="image", desc="live", disable=None) as bar:
                for topic, _, message in bag.messages([CAMERA_INFO_TOPIC, RAW_IMAGE_TOPIC]):
                    copied = copy_message(message, message.__msgtype__)
                    if topic == CAMERA_INFO_TOPIC:
                        self._infos.publish(copied)
                        continue
                    stamp = stamp_ns(message)
                    self._images.publish(copied)
                    pose = poses.get(stamp)
                    answers = [topic for topic, found in offline.items() if pose in found]
                    self._wait(
                        partial(self._answered, stamp, pose, answers),
                        _ANSWER_TIMEOUT,
                        f"no answer to the image of {stamp}",
                    )
                    count += 1
                    bar.update()
        return count

    def pace(self, images: Path, rate: float) -> dict[int, float]:
        """All images of a bag at a steady rate: time.monotonic() of each, by its stamp."""
        with open_bag(images) as bag:
            messages = [
                copy_message(message, message.__msgtype__)
                for _, _, message in bag.messages([CAMERA_INFO_TOPIC, RAW_IMAGE_TOPIC])
            ]
        sent: dict[int, float] = {}
        start = time.monotonic()
        for message in messages:
            if isinstance(message, CameraInfo):
                self._infos.publish(message)
                continue
            due = start + len(sent) / rate
            self._wait_until(due)
            sent[stamp_ns(message)] = time.monotonic()
            self._images.publish(message)
        self._wait_until(time.monotonic() + _LAST_ANSWERS)
        return sent

    def _wait_until(self, due: float) -> None:
        """Hear what comes until then (time.monotonic())."""
        self._wait(lambda: time.monotonic() >= due, _START_TIMEOUT, "")

    def _answered(self, image: int, pose: int | None, topics: list[str]) -> bool:
        return image in self._detected and all(pose in self.heard[topic] for topic in topics)

    def _wait(self, condition: Callable[[], Any], timeout: float, fault: str) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            for name, process in self._processes.items():
                if process.poll() is not None:
                    raise ValueError(f"{name} ended with exit code {process.returncode}")
            if time.monotonic() > deadline:
                raise ValueError(f"{fault} for {timeout:.0f} s")
            self._executor.spin_once(timeout_sec=0.002)


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the live nodes and replay agree."""

    images: int
    live: Mapping[str, int]  # messages by topic
    replayed: Mapping[str, int]
    identical: Mapping[str, int]

    @property
    def complete(self) -> bool:
        """Whether all messages are the same, and there is any."""
        return self.live == self.replayed == self.identical and self.live[POSE] > 0


def fly(
    images: Path, replayed: Path, parameters: list[str], landmarks: Path | None = None
) -> Agreement:
    """Start both nodes, send them all images, and compare.

    Args:
        images: directory with the bag, the marker map and the parameters.
        replayed: directory that replay wrote.
        parameters: further ones of the localizer, ``name:=value``.
        landmarks: map file of features; None: markers.

    Raises:
        ValueError: when a node ends or does not answer.
    """
    offline = _offline(replayed)
    with flying(images, parameters, landmarks) as flight:
        count = flight.send(images, offline)
        live = flight.heard
    return Agreement(
        count,
        {topic: len(found) for topic, found in live.items()},
        {topic: len(found) for topic, found in offline.items()},
        {
            topic: sum(live[topic].get(stamp) == message for stamp, message in found.items())
            for topic, found in offline.items()
        },
    )


def latencies(
    images: Path, rate: float, parameters: list[str], landmarks: Path | None = None
) -> tuple[int, list[float]]:
    """Start both nodes and send them the images at a steady rate, as a camera does.

    Args:
        images: directory with the bag, the marker map and the parameters.
        rate: Hz.
        parameters: further ones of the localizer, ``name:=value``; poses must keep the stamps.

    Returns:
        how many images were sent, and the seconds from sending an image to hearing its pose, of
        those that were answered.

    Raises:
        ValueError: when a node ends.
    """
    with flying(images, parameters, landmarks) as flight:
        sent = flight.pace(images, rate)
        answered = flight.arrivals
    return len(sent), [answered[stamp] - sent[stamp] for stamp in answered.keys() & sent.keys()]


def _offline(replayed: Path) -> dict[str, dict[int, Any]]:
    found: dict[str, dict[int, Any]] = {topic: {} for topic in KINDS}
    with open_bag(replayed / "result") as bag:
        for topic, _, message in bag.messages([topic for topic in KINDS if topic in bag.topics]):
            found[topic][stamp_ns(message)] = copy_message(message, message.__msgtype__)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print how the nodes and replay agree; 1 if they do not."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.image_flight",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("images", type=Path, help="directory that simulate --images wrote")
    parser.add_argument("replayed", type=Path, nargs="?", help="directory that replay wrote")
    parser.add_argument("--rate", type=float, metavar="HZ", help="of the images, to time the poses")
    parser.add_argument(
        "-p", dest="parameters", action="append", default=[], metavar="NAME:=VALUE",
        help="parameter of the localizer, as for replay",
    )  # fmt: skip
    parser.add_argument("--map", type=Path, metavar="FILE", help="of landmarks, for features")
    options = parser.parse_args(arguments)
    if (options.replayed is None) == (options.rate is None):
        parser.error("give either what replay wrote or --rate")
    # Nobody else's nodes shall hear these images.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if options.rate is not None:
        sent, taken = latencies(options.images, options.rate, options.parameters, options.map)
        if not taken:
            raise ValueError(f"none of {sent} images was answered")
        middle, most = 1e3 * np.quantile(taken, [0.5, 0.95])
        sys.stdout.write(
            f"{len(taken)} poses of {sent} images at {options.rate:g} Hz, from image to pose: "
            f"p50 {middle:.1f} ms, p95 {most:.1f} ms\n"
        )
        return 0
    found = fly(options.images, options.replayed, options.parameters, options.map)
    sys.stdout.write(f"{found.images} images\n")
    for topic in KINDS:
        sys.stdout.write(
            f"{topic}: {found.live[topic]} live, {found.replayed[topic]} replayed, "
            f"{found.identical[topic]} identical\n"
        )
    return 0 if found.complete else 1


if __name__ == "__main__":
    sys.exit(main())
