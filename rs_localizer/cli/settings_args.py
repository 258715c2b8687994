# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Arguments that say with which settings, and from which topics of a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rs_localizer.cli import WORKING
from rs_localizer.cli.options import UsageError
from rs_localizer.io.topics import IMAGE
from rs_localizer.pipeline.inputs import INPUTS

if WORKING:
    from rs_localizer.config import NodeConfig
    from rs_localizer.settings import build, camera_values, load_params_file, parse_assignment


def given_values(
    args: Any,
    also: Sequence[str] = (),
    check: Callable[[NodeConfig], object] | None = None,
) -> dict[str, Any]:
    """The values of a camera's file, of a params file, and single ones, by dotted name.

    Each goes over those before.

    Args:
        args: with ``params`` and ``assignments``, and ``calibration`` where there is a lens.
        also: further assignments, ``name:=value``.
        check: raises ``ValueError`` for settings that cannot be used.

    Raises:
        UsageError: for what is no setting, or a wrong value, with where it was given.
    """
    where, values = "--camera", dict[str, Any]()
    lens = getattr(args, "calibration", None)
    try:
        if lens is not None:
            values = camera_values(lens)
            _check(values, check)
        where = "--params"
        if args.params is not None:
            values |= load_params_file(args.params)
            where = f"--params: {args.params}"
            _check(values, check)
        where = "-p"
        values |= dict(map(parse_assignment, [*args.assignments, *also]))
        _check(values, check)
    except ValueError as error:
        raise UsageError(f"{where}: {error}") from error
    return values


def given_settings(
    args: Any,
    also: Sequence[str] = (),
    check: Callable[[NodeConfig], object] | None = None,
) -> NodeConfig:
    """The settings of :func:`given_values`."""
    return build(given_values(args, also, check))


def _check(values: dict[str, Any], check: Callable[[NodeConfig], object] | None) -> None:
    config = build(values)
    if check is not None:
        check(config)


def remapped(options: Any) -> dict[str, str]:
    """Topics that were given by ``-r``, by input, images among them.

    Raises:
        UsageError: for what is no input.
    """
    known, topics = (*INPUTS, IMAGE), dict[str, str]()
    for text in options.remaps:
        name, given, topic = text.partition(":=")
        if not given or not topic or name not in known:
            raise UsageError(f"-r: expected INPUT:=TOPIC of {', '.join(known)}; got {text!r}")
        topics[name] = topic if topic.startswith("/") else f"/{topic}"
    return topics


def given_topics(options: Any) -> dict[str, str | None]:
    """Those of the localizer's inputs."""
    return {name: topic for name, topic in remapped(options).items() if name in INPUTS}
