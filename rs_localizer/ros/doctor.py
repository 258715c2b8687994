# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run rs_localizer doctor``: describe in one screen what a localizer finds on a robot.

It looks for the topics and runs the node itself on them, under names of its own and without sending
transforms. It prints what the node finds.
"""

import sys
import time
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image, PointCloud2

from rs_localizer.io import topics
from rs_localizer.pipeline.inputs import CAMERA_INFO_TYPE, CLOUD_TYPE, IMU_TYPE
from rs_localizer.process.stopping import StopRequest
from rs_localizer.ros.localizer.health import DEVIATION
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.diagnostics import Health, Level, State
from rs_localizer.ros.node.managed import executor_of, spin
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.subscriptions import LATCHED, Inputs, Topic, node_of
from rs_localizer.settings import as_tuple, settings, write_parameters

# s in which clouds show their fields; the graph is known and each sensor has spoken by then.
_LOOKING = 4.0
# s in which the node has to localize; with what comes before, half a minute.
_WORKING = 22.0
# A state that holds so long (s) is the answer.
_STEADY = 4.0
_UNHEARD = Refusals(lambda _: None)
_NAMESPACE, _IMAGE_TYPE = "/doctor", "sensor_msgs/msg/Image"
FILE = Path("rs_localizer_doctor.yaml")


def input_of(fields: Collection[str]) -> str | None:
    """Return the input that a cloud with these fields is for; None if there is none."""
    names = set(fields)
    if "residual" in names:  # a localizer's own inliers
        return None
    if {"x", "y", "z", "u", "v"} <= names:
        return topics.CORRESPONDENCES
    if {"u", "v"} <= names and names & {"id", "descriptor"}:
        return topics.KEYPOINTS
    if {"x", "y", "z"} <= names and names & {"id", "descriptor"}:
        return topics.MAP_POINTS
    return None


class Surroundings:
    """Published topics by the input that they are for, and the sizes of images.

    Args:
        node: listens, while :meth:`until` runs.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard: dict[str, Inputs] = {}  # by topic
        self._found: dict[str, set[str]] = {}
        self.images: dict[str, str] = {}

    @property
    def inputs(self) -> dict[str, list[str]]:
        return {wanted: sorted(names) for wanted, names in self._found.items()}

    def until(self, stopped: Callable[[], bool]) -> None:
        """Look at the surroundings until it is to stop."""
        executor = executor_of(self._node.context)
        executor.add_node(self._node)
        while not stopped():
            self._find()
            executor.spin_once(timeout_sec=0.1)
        for inputs in self._heard.values():
            inputs.close()
        executor.remove_node(self._node)

    def _find(self) -> None:
        takers = {
            CLOUD_TYPE: (PointCloud2, self._take_cloud),
            _IMAGE_TYPE: (Image, self._take_image),
        }
        for name, kinds in self._node.get_topic_names_and_types():
            if not self._node.count_publishers(name):
                continue
            for kind, (message, take) in takers.items():
                if kind in kinds and name not in self._heard:
                    topic = Topic(message, partial(take, name), LATCHED)
                    self._heard[name] = Inputs(self._node, {name: topic}, _UNHEARD)
            for kind, wanted in ((CAMERA_INFO_TYPE, topics.CAMERA_INFO), (IMU_TYPE, topics.IMU)):
                if kind in kinds:
                    self._found.setdefault(wanted, set()).add(name)

    def _take_cloud(self, name: str, cloud: Any) -> None:
        if (wanted := input_of([field.name for field in cloud.fields])) is not None:
            self._found.setdefault(wanted, set()).add(name)

    def _take_image(self, name: str, image: Any) -> None:
        self.images[name] = f"{image.width} x {image.height}"


class DoctorNode(LocalizerNode):
    """A localizer that disturbs nobody and reports what it finds.

    Args:
        around: published topics; the node subscribes to the first topic of each input.
        options: of rclpy's node.
    """

    def __init__(self, around: Surroundings, **options: Any) -> None:
        self._around, inputs = around, around.inputs
        words = ["-p", "publish_tf:=none", "-r", f"__ns:={_NAMESPACE}"]
        words += ["-r", f"{topics.DIAGNOSTICS}:={_NAMESPACE}{topics.DIAGNOSTICS}"]
        for name, (topic, *_) in inputs.items():
            words += ["-r", f"{name}:={topic}"]
        super().__init__(cli_args=["--ros-args", *words], **options)
        self.get_logger().set_level(LoggingSeverity.FATAL)  # all is in the report

    def report(self) -> Iterator[str]:
        """Yield lines on what was found; the last one is the answer."""
        health, frame = self.examine()
        values = health.values
        if topics.CAMERA_INFO not in self._around.inputs:
            yield _line("camera_info", f"no topic has the type {CAMERA_INFO_TYPE}")
        if not {topics.CORRESPONDENCES, topics.KEYPOINTS} & self._around.inputs.keys():
            yield _line("correspondences", "no PointCloud2 has fields u v, with x y z, or with id")
        for name, others in self._around.inputs.items():
            heard = values.get(f"Topic {others[0]}", "not needed")
            more = f"; also {', '.join(others[1:])}" if others[1:] else ""
            yield _line(name, f"{others[0]}: {heard}{more}")
        yield _line("camera", self._camera(frame))
        config = self.config
        seen = values.get("Readout time seen (ms)", "not seen yet")
        yield _line(
            "shutter",
            f"readout_time {1e3 * config.readout_time:g} ms, {config.scan_direction}; by the "
            f"motion: {seen}",
        )
        yield _line("stamps", f"{values.get('Delay of the stamp p50 (ms)', 'no')} ms old at a pose")
        senders = self.get_publishers_info_by_topic(topics.TF)
        names = ", ".join(sorted({node_of(each) for each in senders})) or "nobody"
        yield _line("TF", f"is sent by {names}")
        for key, value in values.items():
            if key.startswith(("Notice: ", "Refused: ", "Residual RMS", "IMU")):
                yield _line(*key.partition(": ")[::2], value) if ": " in key else _line(key, value)
        yield answer(health)

    def _camera(self, frame: str) -> str:
        calibration = None if self._frames is None else self._frames.calibration
        if calibration is None:
            return "no usable camera_info"
        size = f"{calibration.width} x {calibration.height}"
        others = [f"{name}: {own}" for name, own in self._around.images.items() if own != size]
        text = f"; not that of the images on {', '.join(others)}" if others else ""
        return f"{size}, {calibration.distortion_model}, frame {frame!r}{text}"

    def write(self, path: Path) -> None:
        """Write the parameters that it was given, for the localizer."""
        values = {name: as_tuple(self.get_parameter(name).value) for name in settings()}
        own = {k: v for k, v in values.items() if v != settings()[k].default}
        write_parameters(path, {"readout_time": values["readout_time"], **own})


def _line(*words: str) -> str:
    return f"{words[0]:<20}{' '.join(words[1:])}"


def answer(health: Health) -> str:
    """Return the state, how well the pose is known, and what is wrong."""
    words = [] if health.level == Level.OK else [health.message]
    if health.state in (State.TRACKING, State.LOCALIZED):
        words.insert(0, f"{health.state}, {health.values[DEVIATION]} cm")
    return "; ".join(words)


def run(stop: StopRequest, args: list[str] | None = None) -> int:
    """Look around, print and write; return 0 if a localizer works with what was found."""
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    looking = Node("doctor")
    around, end = Surroundings(looking), time.monotonic() + _LOOKING
    around.until(lambda: stop.requested or time.monotonic() > end)
    looking.destroy_node()
    try:
        node = DoctorNode(around)
    except ValueError as error:
        sys.stderr.write(f"doctor: {error}\n")
        rclpy.try_shutdown()
        return 1
    node.trigger_configure()
    node.trigger_activate()
    deadline, since = time.monotonic() + _WORKING, time.monotonic()

    def done() -> bool:
        nonlocal since
        now = time.monotonic()
        if node.statistics.summary().last is None or node.examine()[0].level != Level.OK:
            since = now
        return stop.requested or now > deadline or now - since > _STEADY

    spin(node, done)
    lines = list(node.report())
    well = node.examine()[0].level == Level.OK
    node.write(FILE)
    node.destroy_node()
    rclpy.try_shutdown()
    words = [f"{name}:={found[0]}" for name, found in around.inputs.items()]
    command = " ".join(
        ["ros2 launch rs_localizer localizer.launch.py", *words, f"params_file:={FILE}"]
    )
    sys.stdout.write("\n".join([*lines[:-1], command, lines[-1]]) + "\n")
    return 0 if well else 1
