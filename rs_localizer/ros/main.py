# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The executables: take signals in hand, then import what takes long."""

import argparse
import importlib
import sys
from collections.abc import Sequence
from functools import partial

import rs_localizer
from rs_localizer.process import ignore_working_folder, limit_threads
from rs_localizer.process.missing import explain
from rs_localizer.process.stopping import StopRequest

_ROS_ARGUMENTS, _END_OF_THEM = "--ros-args", "--"  # what is between them is for ROS

# For each executable, the class of its node or its function below rs_localizer.ros, the name of a
# node with settings, and a description.
_PROGRAMS = {
    "localizer": ("localizer.node.LocalizerNode", "rs_localizer",
                  "Poses and velocities from correspondences or keypoints."),
    "marker_detector": ("detector.markers.MarkerDetectorNode", "marker_detector",
                        "Correspondences from images of markers and boards."),
    "feature_detector": ("detector.features.FeatureDetectorNode", "feature_detector",
                         "Keypoints with descriptors from images."),
    "doctor": ("doctor.run", "",
               "What a localizer finds on a running robot; writes its parameters."),
}  # fmt: skip


def check_words(name: str, words: Sequence[str]) -> None:
    """Answer a question of the command line, or refuse it: both end the process.

    Args:
        name: of the executable.
        words: arguments of the command line.

    Raises:
        SystemExit: for ``--help``, ``--version``, and arguments that are neither for ROS nor known.
    """
    own, for_ros = [], False
    for word in words:
        for_ros = word == _ROS_ARGUMENTS or (for_ros and word != _END_OF_THEM)
        if not for_ros and word != _END_OF_THEM:
            own.append(word)
    if not own:
        return
    _, node, about = _PROGRAMS[name]
    parser = argparse.ArgumentParser(
        f"ros2 run rs_localizer {name}",
        f"%(prog)s {_ROS_ARGUMENTS} [-p NAME:=VALUE] [--params-file FILE]",
        f"{about} It ends with Ctrl-C. The commands that need no ROS: rs_localizer --help.",
        _parameters(node) if node else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    version = f"rs_localizer {rs_localizer.__version__}"
    parser.add_argument("--version", action="version", version=version)
    parser.parse_args(own)


def _parameters(node: str) -> str:
    from rs_localizer.settings import NODES, settings

    (kind,) = (kind for kind, node_name in NODES.items() if node_name == node)
    lines = ["parameters (name: default):"]
    for setting_name, one in settings(kind).items():
        default = one.default if one.default != "" else '""'
        choices = f" ({', '.join(one.choices)})" if one.choices else ""
        lines += [f"  {setting_name}: {default}", f"      {one.description}{choices}"]
    return "\n".join(lines).replace("%", "%%")


def _run(name: str, args: list[str] | None = None) -> int:
    ignore_working_folder()
    limit_threads()
    with StopRequest() as stop:
        try:
            with stop.at_once():
                check_words(name, sys.argv[1:] if args is None else args)
                # The imports that follow take long.
                path, node, _ = _PROGRAMS[name]
                module, _, kind = path.rpartition(".")
                make = getattr(importlib.import_module(f"rs_localizer.ros.{module}"), kind)
                if node:
                    from rs_localizer.ros.node.managed import run

                    make = partial(run, make, node)
        except ImportError as error:
            sys.stderr.write(f"{name}: {explain(error)}\n")
            return 1
        code: int = make(stop, args)
        return code


main = partial(_run, "localizer")
"""Run the localizer until Ctrl-C or SIGTERM, which end it with exit code 0 at any time."""
marker_detector = partial(_run, "marker_detector")
feature_detector = partial(_run, "feature_detector")
doctor = partial(_run, "doctor")
