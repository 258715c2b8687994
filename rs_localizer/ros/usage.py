"""What the executables of the nodes answer to --help and --version, instead of starting a node."""

from __future__ import annotations

from collections.abc import Sequence

import rs_localizer

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


def _help(name: str) -> str:
    from rs_localizer.config import DetectorConfig, FeatureConfig, NodeConfig
    from rs_localizer.settings import settings

    kind, what = {
        "localizer": (NodeConfig, "Poses and velocities from correspondences or keypoints."),
        "marker_detector": (DetectorConfig, "Correspondences from images of markers and boards."),
        "feature_detector": (FeatureConfig, "Keypoints with descriptors from images."),
    }[name]
    lines = [
        f"usage: ros2 run rs_localizer {name} --ros-args [-p NAME:=VALUE] [--params-file FILE]",
        "",
        f"{what} A ROS 2 node, which runs until Ctrl-C.",
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
