# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The executables of the nodes: take signals in hand, then import what takes long."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from functools import partial

import rs_localizer
from rs_localizer.process import ignore_working_folder, limit_threads
from rs_localizer.process.missing import explain
from rs_localizer.process.stopping import StopRequest

_HELP, _VERSION = ("-h", "--help"), ("--version",)
_ROS_ARGUMENTS = "--ros-args"  # what follows is for ROS


def answer(name: str, words: Sequence[str]) -> str | None:
    """The text that is asked for; None when a node is to start.

    Args:
        name: of the executable.
        words: arguments of the command line.
    """
    own = list(words)
    if _ROS_ARGUMENTS in own:
        own = own[: own.index(_ROS_ARGUMENTS)]
    if any(word in _VERSION for word in own):
        return f"rs_localizer {rs_localizer.__version__}\n"
    return _help(name) if any(word in _HELP for word in own) else None


# Of each executable: name and class of its node, and what it makes.
_NODES = {
    "localizer": (
        "rs_localizer",
        "localizer.node.LocalizerNode",
        "Poses and velocities from correspondences or keypoints.",
    ),
    "marker_detector": (
        "marker_detector",
        "detector.markers.MarkerDetectorNode",
        "Correspondences from images of markers and boards.",
    ),
    "feature_detector": (
        "feature_detector",
        "detector.features.FeatureDetectorNode",
        "Keypoints with descriptors from images.",
    ),
}


def _help(name: str) -> str:
    from rs_localizer.settings import NODES, settings

    node, _, about = _NODES[name]
    (kind,) = (kind for kind, node_name in NODES.items() if node_name == node)
    lines = [
        f"usage: ros2 run rs_localizer {name} --ros-args [-p NAME:=VALUE] [--params-file FILE]",
        "",
        f"{about} A ROS 2 node, which runs until Ctrl-C.",
        "The commands that need no ROS: rs_localizer --help.",
        "",
        "parameters (name: default):",
    ]
    for setting_name, one in settings(kind).items():
        default = one.default if one.default != "" else '""'
        lines.append(f"  {setting_name}: {default}")
        choices = f" ({', '.join(one.choices)})" if one.choices else ""
        lines.append(f"      {one.description}{choices}")
    return "\n".join(lines) + "\n"


def example_matcher(args: list[str] | None = None) -> int:
    """Run the matcher of the bundled recording until it is stopped likewise."""
    words = sys.argv[1:] if args is None else args
    if not {*_HELP}.isdisjoint(words):
        sys.stdout.write(
            "usage: ros2 run rs_localizer example_matcher\n\nPublishes the matches of the bundled "
            "webcam recording, and prints the poses of a localizer.\n"
        )
        return 0
    ignore_working_folder()
    with StopRequest() as stop:
        try:
            with stop.at_once():
                from rs_localizer.ros import example_matcher as node
        except ImportError as error:
            sys.stderr.write(f"example_matcher: {explain(error)}\n")
            return 1
        node.run(stop, args)
    return 0


def doctor(args: list[str] | None = None) -> int:
    """Say what a localizer finds on a running robot, and whether it works."""
    words = sys.argv[1:] if args is None else args
    if not {*_HELP}.isdisjoint(words):
        sys.stdout.write(
            "usage: ros2 run rs_localizer doctor [--ros-args -p readout_time:=0.02 ...]\n\nFinds "
            "the topics of a running robot, localizes for some seconds, and says in one screen "
            "what it has found and what is wrong; writes rs_localizer_doctor.yaml.\n"
        )
        return 0
    ignore_working_folder()
    limit_threads()
    with StopRequest() as stop:
        try:
            with stop.at_once():
                from rs_localizer.ros import doctor as program
        except ImportError as error:
            sys.stderr.write(f"doctor: {explain(error)}\n")
            return 1
        return program.run(stop, args)


def _run(name: str, args: list[str] | None = None) -> int:
    ignore_working_folder()
    limit_threads()
    with StopRequest() as stop:
        try:
            with stop.at_once():
                text = answer(name, sys.argv[1:] if args is None else args)
                if text is not None:
                    sys.stdout.write(text)
                    return 0
                # What takes long.
                from rs_localizer.ros.node.managed import run

                node, path, _ = _NODES[name]
                module, _, kind = path.rpartition(".")
                make = getattr(importlib.import_module(f"rs_localizer.ros.{module}"), kind)
        except ImportError as error:
            sys.stderr.write(f"{name}: {explain(error)}\n")
            return 1
        return run(make, node, stop, args)


main = partial(_run, "localizer")
"""Run the localizer until Ctrl-C or SIGTERM, which end it with exit code 0 at any time."""
marker_detector = partial(_run, "marker_detector")
feature_detector = partial(_run, "feature_detector")
