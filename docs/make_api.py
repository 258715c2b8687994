# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes the pages that repeat code: the reference of the library, and the reasons of refusals.

    python docs/make_api.py

``docs/api.md`` comes from the docstrings of the public names, the first part of ``docs/reasons.md``
from the table that ``replay`` prints from; what follows there is written by hand, and kept.
"""

from __future__ import annotations

import enum
import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import rs_localizer
from rs_localizer.pipeline.refusal import IMU_REASONS, REASONS, Meaning

PAGE = Path(__file__).with_name("api.md")
REASONS_PAGE = Path(__file__).with_name("reasons.md")
_REASONS_INTRODUCTION = """\
# Reasons, notices and states: what it says, and what to do

## Why a frame has no pose

Written by `python docs/make_api.py` from `rs_localizer/pipeline/refusal.py`. The reasons are the
same in the library (`Failure.reason`), in what `replay` prints, in the log and in `/diagnostics`.

| reason | means | look at |
|---|---|---|
"""
_IMU_INTRODUCTION = """
## Why the IMU is not used for an image

The camera continues alone, and the image still has its pose: [imu.md](imu.md).

| reason | means | look at |
|---|---|---|
"""
_BY_HAND = "\n<!-- From here on written by hand"
_INTRODUCTION = """\
# Library reference

Written by `python docs/make_api.py` from the docstrings: mend these, not this page.

`import rs_localizer as rsl`. Arrays may be anything that NumPy takes. Points are in metres in the
frame of the map, pixels raw (distorted, centre of the first pixel at 0, 0), poses `camera_from_map`
unless a name says otherwise, row time `tau` runs from -0.5 (first exposed row) over 0 (middle) to
0.5. Velocities of an estimate are per readout; `camera_state` has them per second. "No pose" is a
`Failure`, which is false; bad input is a `ValueError` that says what was found.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([_INTRODUCTION, *_index(), *(_entry(name) for name in rs_localizer.__all__)])


def _index() -> Iterator[str]:
    for name in rs_localizer.__all__:
        item = getattr(rs_localizer, name)
        first = (inspect.getdoc(item) or "").split("\n\n")[0].replace("\n", " ")
        yield f"* [`{name}`](#{name.lower()}): {first}"
    yield ""


def _entry(name: str) -> str:
    item = getattr(rs_localizer, name)
    parts = [f"## {name}", ""]
    if not (isinstance(item, type) and issubclass(item, enum.Enum)):
        parts += [_code(f"{name}{_signature(item)}"), ""]
    parts += [_text(item), ""]
    if isinstance(item, type):
        parts += [*_members(item)]
    return "\n".join(parts)


def _members(kind: type) -> Iterator[str]:
    if issubclass(kind, enum.Enum):
        yield f"Values: {', '.join(f'`{member.value}`' for member in kind)}\n"
        return
    if is_dataclass(kind) and any(not row.endswith("|  |") for row in _fields(kind)):
        yield "\n".join(["| field | |", "|---|---|", *_fields(kind)]) + "\n"
    for name, member in sorted(_public(kind).items()):
        if isinstance(member, property):
            yield f"### {kind.__name__}.{name}\n\n{_text(member)}\n"
        elif inspect.isfunction(member):
            yield f"### {kind.__name__}.{name}\n\n{_code(name + _signature(member))}\n"
            yield f"{_text(member)}\n"


def _fields(kind: type) -> Iterator[str]:
    """Fields with what their setting, or the comment beside them, says."""
    for item in fields(kind):
        told = item.metadata.get("description")
        if told is None:
            match = next(filter(None, (_beside(base, item.name) for base in kind.__mro__)), None)
            told = match[1] if match else ""
        default = "" if item.default is MISSING else f" = {_plain(repr(item.default))}"
        yield f"| `{item.name}{default}` | {told} |"


def _beside(kind: type, name: str) -> re.Match[str] | None:
    if not kind.__module__.startswith("rs_localizer."):
        return None
    pattern = rf"^    {name}: [^\n#]*#\s*(.+)$"
    return re.search(pattern, inspect.getsource(kind), re.MULTILINE)


def _public(kind: type) -> dict[str, Any]:
    """Members of a class and of those it comes from, as far as they are ours and documented."""
    found: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        if base.__module__.startswith("rs_localizer."):
            found |= vars(base)
    return {
        name: member
        for name, member in found.items()
        if not name.startswith("_") and inspect.getdoc(member) and not inspect.isclass(member)
    }


def _signature(item: Any) -> str:
    return _plain(str(inspect.signature(item)).replace("self, ", "").replace("(self)", "()"))


def _plain(text: str) -> str:
    """Without the quotes of annotations, and enumerations by their values."""
    text = re.sub(r"<\w+\.\w+: ('\w*')>", r"\1", text)
    text = re.sub(r"ForwardRef\('([^']*)'\)", r"\1", text)  # of a NamedTuple
    return re.sub(r"(: |-> )'([^']*)'", r"\1\2", text).replace("<factory>", "...")


def _code(text: str) -> str:
    return f"```python\n{text}\n```"


def _text(item: Any) -> str:
    """A docstring; lists of arguments stay as they are written."""
    doc = inspect.getdoc(item) or ""
    plain, *lists = doc.split("\n\nArgs:")
    if not lists:
        plain, *lists = doc.split("\n\nReturns:")
        title = "Returns:"
    else:
        title = "Args:"
    if not lists:
        plain, *lists = doc.split("\n\nRaises:")
        title = "Raises:"
    text = plain.replace(":class:", "").replace(":meth:", "").replace(":func:", "")
    return text if not lists else f"{text}\n\n```text\n{title}{lists[0]}\n```"


def reasons_page() -> str:
    """The page of the reasons, with the part that is written by hand as it stands."""
    written = REASONS_PAGE.read_text(encoding="utf-8")
    by_hand = written[written.index(_BY_HAND) :]
    tables = _REASONS_INTRODUCTION + _rows(REASONS) + _IMU_INTRODUCTION + _rows(IMU_REASONS)
    return tables + by_hand


def _rows(reasons: Mapping[str, Meaning]) -> str:
    return "".join(f"| `{name}` | {means} | {look} |\n" for name, (means, look) in reasons.items())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    REASONS_PAGE.write_text(reasons_page(), encoding="utf-8")
