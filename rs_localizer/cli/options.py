# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Options of a command: a dataclass, whose fields, types and texts make its parser.

The class of a command derives from classes of options that several commands share. The docstring of
each class is the title of its group in the help.
"""

from __future__ import annotations

import argparse
import math
import re
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from rs_localizer.config import meant

T = TypeVar("T")
MORE = " (--help says more)"
"""Behind faults of the command line."""


class UsageError(ValueError):
    """Wrong arguments, among them those that argparse cannot see by itself."""


def argument(help: str, metavar: str, default: Any = MISSING) -> Any:  # noqa: A002
    """Declare a field that is given by its place; a list takes one or more.

    A ``default`` makes it optional; ``list``: none or more.
    """
    return _field(default, {"help": help, "metavar": metavar, "positional": True})


def option(
    help: str,  # noqa: A002
    metavar: str = "",
    default: Any = None,
    *,
    flag: str = "",
    choices: Sequence[str] = (),
    least: float = -math.inf,
    most: float = math.inf,
    above: float = -math.inf,
    required: bool = False,
) -> Any:
    """Declare a field that is given by ``--its-name``.

    Args:
        help: description; a default that is not None, False or an empty list is added.
        default: ``list`` for one that may be repeated; of a switch, False.
        flag: another name, such as ``-p``, or several.
        least, most, above: limits of a number, which is more than the last.
    """
    return _field(default, {
        "help": help, "metavar": metavar, "flag": flag, "choices": tuple(choices),
        "limits": {"least": least, "most": most, "above": above}, "required": required,
        "positional": False,
    })  # fmt: skip


def _field(default: Any, about: dict[str, Any]) -> Any:
    if default is list:
        return field(default_factory=list, metadata=about)
    return field(default=default, metadata=about)


@dataclass(frozen=True, kw_only=True)
class SettingOptions:
    """settings of the localizer."""

    params: Path | None = option("a ROS 2 params file, such as calibrate writes", "FILE")
    assignments: list[str] = option(
        "one setting, as after --ros-args; may be repeated", "NAME:=VALUE", list, flag="-p"
    )


@dataclass(frozen=True, kw_only=True)
class TopicOptions:
    """topics of the recording (found by name and type)."""

    remaps: list[str] = option(
        "another topic of an input: -r imu:=/imu/data; may be repeated", "INPUT:=TOPIC", list,
        flag="-r",
    )  # fmt: skip
    # No option: what is read, of one of several cameras.
    recording: Path = Path()


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """results."""

    overwrite: bool = option("replace an earlier result", default=False)


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """of all commands."""

    json: bool = option("print the result as JSON", default=False)
    verbose: bool = option("print the traceback of a fault", default=False, flag="-v --verbose")


class Parser(argparse.ArgumentParser):
    """Reports faults by a :class:`UsageError`, with the option that may be meant."""

    def __init__(self, **words: Any) -> None:
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(allow_abbrev=False, formatter_class=form, **words)

    def error(self, message: str) -> NoReturn:
        if unknown := re.match(r"unrecognized arguments: (-[^\s=]+)", message):
            known = [name for action in self._actions for name in action.option_strings]
            message += meant(unknown[1], known)
        raise UsageError(f"{message}{MORE}")


def add_options(parser: argparse.ArgumentParser, kind: type[Any], *more: type[Any]) -> None:
    """Add an argument for each field of a dataclass of options, and of ``more`` of them."""
    for item in fields(kind):  # those of bases come first on the command line
        if item.metadata.get("positional"):
            _add(parser, kind, item)
    # Bases come last in the help: what is the command's own is looked for first.
    for owner in (*kind.__mro__[:-1], *more):
        title = " ".join((owner.__doc__ or "").split()).rstrip(".")
        group = parser if owner is kind else parser.add_argument_group(title)
        for item in fields(owner):
            own = item.name in vars(owner).get("__annotations__", {})
            if own and not item.metadata.get("positional", True):
                _add(group, owner, item)


def _add(group: argparse._ActionsContainer, kind: type[Any], item: Any) -> None:
    about, name = item.metadata, item.name
    one, many = _element(typing.get_type_hints(kind)[name])
    repeated = many is list
    if typing.get_origin(one) is tuple:  # each time this many
        one, many = _element(one)
    words: dict[str, Any] = {"help": about["help"].replace("%", "%%")}
    if one is bool:
        words["action"] = "store_true"
    else:
        limits, words["metavar"] = about.get("limits", {}), about["metavar"] or None
        types = {float: number(**limits), int: number(**limits, kind=int)}
        words["type"] = types.get(one, one)
        if about.get("choices"):
            words["choices"] = about["choices"]
        if isinstance(many, int):
            words |= {"nargs": many, "metavar": tuple(about["metavar"].split())}
    if about["positional"]:
        if many is list:
            words["nargs"] = "+" if item.default_factory is MISSING else "*"
        elif item.default is not MISSING:
            words |= {"nargs": "?", "default": item.default}
        group.add_argument(name, **words)
        return
    if repeated:
        words |= {"default": [], "action": "append", "required": about["required"]}
    elif one is not bool:
        words |= {"default": item.default, "required": about["required"]}
        if item.default is not None:
            words["help"] += f" (default: {item.default})"
    flag = about["flag"] or f"--{name.replace('_', '-')}"
    group.add_argument(*flag.split(), dest=name, **words)


def _element(hint: Any) -> tuple[Any, Any]:
    """Return the type of one value, and the count: None for one, ``list``, or a number."""
    if isinstance(hint, types.UnionType):
        hint = next(part for part in hint.__args__ if part is not type(None))
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is list:
        return parts[0], list
    if origin is tuple:
        return parts[0], len(parts)
    return hint, None


def read(kind: type[T], namespace: argparse.Namespace) -> T:
    """Read the options that a parser has found."""
    hints = typing.get_type_hints(kind)
    given = {}
    for item in fields(kind):  # type: ignore[arg-type]
        if not item.metadata:
            continue
        value = getattr(namespace, item.name)
        several = isinstance(value, list) and isinstance(_element(hints[item.name])[1], int)
        given[item.name] = tuple(value) if several else value
    return kind(**given)


def number(
    least: float = -math.inf, most: float = math.inf, above: float = -math.inf,
    kind: type[float] | type[int] = float,
) -> Callable[[str], float]:  # fmt: skip
    """Return a parser of finite numbers in a range, for ``add_argument(type=...)``."""
    wanted = f"must be more than {above:g}"
    if math.isfinite(least):
        wanted = f"must be {least:g} or more"
    if math.isfinite(most):
        wanted = f"must lie between {least:g} and {most:g}"

    def parse(text: str) -> float:
        try:
            value: float = kind(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            what = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(f"must be {what}, got {text!r}")
        if not least <= value <= most or value <= above:
            raise argparse.ArgumentTypeError(f"{wanted}, got {text}")
        return value

    return parse
