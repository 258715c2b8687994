# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Arguments that say with which settings, and from which topics of a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rs_localizer.cli import WORKING
from rs_localizer.cli.options import UsageError
from rs_localizer.io.topics import IMAGE
from rs_localizer.pipeline.inputs import INPUTS

if WORKING:
    from rs_localizer.config import NodeConfig
    from rs_localizer.settings import build, camera_values, load_params_file, parse_assignment


def given_values(args: Any) -> dict[str, Any]:
    """Return the values of a camera's file, a params file and ``-p``, by dotted name.

    Each goes over those before.

    Args:
        args: with ``params`` and ``assignments``, and ``calibration`` where there is a lens.

    Raises:
        UsageError: for an unknown setting, or a wrong value, with its source.
    """
    lens, values = getattr(args, "calibration", None), dict[str, Any]()
    sources: dict[str, Callable[[], Mapping[str, Any]]] = {
        "--camera": lambda: {} if lens is None else camera_values(lens),
        f"--params {args.params}": lambda: (args.params and load_params_file(args.params)) or {},
        "-p": lambda: dict(map(parse_assignment, args.assignments)),
    }
    for where, source in sources.items():
        try:
            values |= source()
            build(values)
        except ValueError as error:
            raise UsageError(f"{where}: {error}") from error
    return values


def given_settings(args: Any) -> NodeConfig:
    """Return the settings of :func:`given_values`."""
    return build(given_values(args))


def remapped(options: Any, known: Sequence[str] = (*INPUTS, IMAGE)) -> dict[str, str]:
    """Return the topics that ``-r`` gives, by input; images are one.

    Raises:
        UsageError: for an unknown input.
    """
    topics = dict[str, str]()
    for text in options.remaps:
        name, given, topic = text.partition(":=")
        if not given or not topic or name not in known:
            raise UsageError(f"-r: expected NAME:=TOPIC of {', '.join(known)}; got {text!r}")
        topics[name] = topic if topic.startswith("/") else f"/{topic}"
    return topics


def given_topics(options: Any) -> dict[str, str | None]:
    """Return the topics of the localizer's inputs."""
    return {name: topic for name, topic in remapped(options).items() if name in INPUTS}
