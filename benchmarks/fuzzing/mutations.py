# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Small damages to bytes, texts and messages that were right."""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable, Sequence
from random import Random
from types import SimpleNamespace
from typing import Any

# Numbers at which sizes, signs and types change.
NUMBERS = (
    0, 1, 2, 3, 7, 8, 9, 16, 127, 128, 255, 256, 1000, 2**15, 2**16 - 1, 2**16, 10**6, 2**31 - 1,
    2**31, 2**32 - 1,
)  # fmt: skip
_LARGE = (2**32, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
REALS = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-9, 1e9, 1e38, 3.5e38, 1e154, 1e300, float("inf"),
    float("-inf"), float("nan"),
)  # fmt: skip
_WORDS = (
    b"nan", b"-inf", b"1e999", b"-1", b"1000000000000", b"9" * 40, b"0x10", b"1_0", b"", b" ",
    b"\n", b"\x00", b"\xff\xfe", b"true", b"null", b"[]", b"{}", b"[[[[", b"&a", b"*a", b"!!python",
    b"<<:", b"- ", b": ", b"'", b'"', b"#", b"...", b"---", b"\t",
)  # fmt: skip
TEXTS = ("", " ", "x", "/", "map", "camera\n", "a" * 300, "\x00", "\ud7ff\U0001f600", "..")
_MOST_DAMAGES = 4


def damaged(data: bytes, others: Sequence[bytes], random: Random) -> bytes:
    """Bytes with one to four damages; ``others`` lend parts of theirs."""
    found = bytearray(data)
    for _ in range(random.randint(1, _MOST_DAMAGES)):
        random.choice(_DAMAGES)(found, others, random)
    return bytes(found)


def _flip(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    if data:
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)


def _set_number(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    code = random.choice(("<B", "<H", ">H", "<I", ">I", "<Q", ">Q"))
    size = struct.calcsize(code)
    if len(data) >= size:
        value = random.choice(NUMBERS + _LARGE) % 2 ** (8 * size)
        struct.pack_into(code, data, random.randrange(len(data) - size + 1), value)


def _set_real(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    code = random.choice(("<f", ">f", "<d", ">d"))
    value = random.choice(REALS)
    size = struct.calcsize(code)
    if len(data) >= size and (size == 8 or not 3.4e38 < abs(value) < float("inf")):
        struct.pack_into(code, data, random.randrange(len(data) - size + 1), value)


def _cut(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    del data[random.randrange(len(data) + 1) :]


def _remove(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    start = random.randrange(len(data) + 1)
    del data[start : start + random.randint(1, 16)]


def _repeat(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    start = random.randrange(len(data) + 1)
    part = data[start : start + random.randint(1, 64)]
    data[start:start] = part * random.choice((1, 2, 50))


def _borrow(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    other = random.choice(others)
    start = random.randrange(len(other) + 1)
    here = random.randrange(len(data) + 1)
    data[here : here + random.randint(0, 32)] = other[start : start + random.randint(1, 64)]


def _word(data: bytearray, others: Sequence[bytes], random: Random) -> None:
    """Put a word in the place of one."""
    start = random.randrange(len(data) + 1)
    end = start
    while end < len(data) and data[end] not in b" \n:,[]{}()\t" and end - start < 40:
        end += 1
    data[start:end] = random.choice(_WORDS)


_Damage = Callable[[bytearray, Sequence[bytes], Random], None]
_DAMAGES: tuple[_Damage, ...] = (
    _flip, _set_number, _set_real, _cut, _remove, _repeat, _borrow, _word, _word,
)  # fmt: skip


def damaged_message(message: Any, random: Random) -> Any:
    """A message with one to four fields changed to what its type can hold."""
    found = copy.deepcopy(message)
    for _ in range(random.randint(1, _MOST_DAMAGES)):
        _damage_field(found, random)
    return found


def _damage_field(message: Any, random: Random) -> None:
    name = random.choice(list(vars(message)))
    value = getattr(message, name)
    if isinstance(value, SimpleNamespace):
        _damage_field(value, random)
    elif isinstance(value, list):
        _damage_list(value, random)
    elif isinstance(value, bool):
        setattr(message, name, not value)
    elif isinstance(value, int):
        signed = name == "sec"
        choice = random.choice((random.choice(NUMBERS), value + random.choice((-1, 1))))
        low, high = (-(2**31), 2**31 - 1) if signed else (0, 2**32 - 1)
        setattr(message, name, min(max(choice, low), high))
    elif isinstance(value, float):
        setattr(message, name, random.choice(REALS))
    elif isinstance(value, str):
        setattr(message, name, random.choice((*TEXTS, value[:-1], value + "x")))
    elif isinstance(value, bytes):
        setattr(message, name, damaged(value, (value,), random))


def _damage_list(items: list[Any], random: Random) -> None:
    """Fields of a cloud, numbers of a calibration."""
    what = random.random()
    if what < 0.2 and items:
        del items[random.randrange(len(items))]
    elif what < 0.4 and items:
        items.insert(random.randrange(len(items) + 1), copy.deepcopy(random.choice(items)))
    elif items:
        place = random.randrange(len(items))
        if isinstance(items[place], SimpleNamespace):
            _damage_field(items[place], random)
        else:
            items[place] = random.choice(REALS)
