# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps as PLY files: vertices with ``x y z``, and ``id`` and the list ``descriptor`` where known.

Descriptors are lists of ``uchar`` or ``float``, equally long at all vertices. Other properties, as
colors and normals, are skipped.
"""

import array
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.io.maps.landmarks import Map, MapError, make_map, map_rows

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {code: name for name, code in list(_TYPES.items())[:8]}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_LINE = 1_000_000
_MOST_HEADER_LINES = 1000
_LONGEST_LIST = 2**16 - 1
# Stands before a list in its row; no property of a file has a space in its name.
_LENGTH = "length of "


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    kind: str
    length: str | None  # the type of a list's length; None: one number


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def lists(self) -> list[_Property]:
        return [item for item in self.properties if item.length is not None]

    def row_type(self, order: str, width: int) -> np.dtype[Any]:
        """Structured type of one row with lists of this length."""
        kinds: list[tuple[Any, ...]] = []
        for item in self.properties:
            if item.length is None:
                kinds.append((item.name, order + item.kind))
            else:
                kinds.append((_LENGTH + item.name, order + item.length))
                kinds.append((item.name, order + item.kind, (width,)))
        try:
            return np.dtype(kinds)
        except ValueError as error:  # a name that comes twice, a list beyond all bounds
            raise MapError(f"the properties of {self.name} make no table: {error}") from error


def read_ply(path: Path, frame: str) -> Map:
    """Read a map; raises MapError for anything that is none, OSError as any file."""
    table = _vertices(path)
    names = table.dtype.names or ()
    if missing := [name for name in "xyz" if name not in names]:
        raise MapError(
            f"the vertices have no property {', '.join(missing)}; found {', '.join(names)}"
        )
    for name in ("x", "y", "z", "id"):
        if name in names and table.dtype[name].shape:
            raise MapError(f"property {name} must be one number, found a list")
    return make_map(
        np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1),
        table["id"] if "id" in names else None,
        table["descriptor"] if "descriptor" in names else None,
        frame,
    )


def write_ply(path: Path, landmarks: Map, *, binary: bool = True) -> None:
    """Write a map; what is read back is the same to the last bit, from text too.

    Raises:
        MapError: for descriptors too long for a PLY file.
    """
    table = map_rows(landmarks)
    header = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0"]
    header.append(f"element vertex {len(table)}")
    kinds: list[tuple[Any, ...]] = []
    for name in table.dtype.names or ():
        kind = table.dtype[name]
        type_name = _NAMES[kind.base.str[1:]]
        if kind.shape:
            if kind.shape[0] > _LONGEST_LIST:
                raise MapError(f"a list of {kind.shape[0]} values does not fit into a PLY file")
            header.append(f"property list ushort {type_name} {name}")
            kinds.append((_LENGTH + name, "<u2"))
        else:
            header.append(f"property {type_name} {name}")
        kinds.append((name, kind.base.newbyteorder("<"), kind.shape))
    rows = np.empty(len(table), kinds)
    for name in table.dtype.names or ():
        rows[name] = table[name]
        if table.dtype[name].shape:
            rows[_LENGTH + name] = table.dtype[name].shape[0]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        if binary:
            file.write(rows.tobytes())
        else:
            file.writelines(_line(row) for row in rows)


def _line(row: Any) -> bytes:
    words = [str(number) for value in row for number in np.atleast_1d(value)]
    return f"{' '.join(words)}\n".encode("ascii")


def _vertices(path: Path) -> NDArray[Any]:
    """The element ``vertex`` as a structured array (n,).

    What stands before the vertices must have no lists; what follows them is not read.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        order, elements = _header(file)
        for element in elements:
            if element.name == "vertex":
                if not element.properties:
                    raise MapError("the vertices have no properties")
                table = (_binary if order else _ascii)(file, element, order, size - file.tell())
                return table[[item.name for item in element.properties]]
            _skip(file, element, order, size - file.tell())
    raise MapError("the file has no element vertex")


def _header(file: IO[bytes]) -> tuple[str, list[_Element]]:
    """Byte order (empty for text) and elements."""
    if file.readline(_LONGEST_LINE).rstrip() != b"ply":
        raise MapError("no PLY file: the first line is not 'ply'")
    order: str | None = None
    elements: list[_Element] = []
    for _ in range(_MOST_HEADER_LINES):
        line = file.readline(_LONGEST_LINE).decode("ascii", "replace")
        match line.split():
            case ["end_header"] if order is not None:
                return order, elements
            case ["format", name, "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit():
                elements.append(_Element(name, int(count[:20])))
            case ["property", "list", length, kind, name] if (
                elements and kind in _TYPES and (length in _TYPES and _TYPES[length][0] != "f")
            ):
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind], None))
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                text = repr(line.strip()[:80]) if line else "the end of the file"
                raise MapError(f"the header is not understood at {text}")
    raise MapError(f"the header has more than {_MOST_HEADER_LINES} lines")


def _skip(file: IO[bytes], element: _Element, order: str, size: int) -> None:
    """Pass over an element that stands before the vertices."""
    if element.lists:
        raise MapError(f"element {element.name} with lists stands before the vertices")
    if order:
        row = element.row_type(order, 0).itemsize
        _check_size(element, row, size)
        file.seek(element.count * row, 1)
        return
    _check_size(element, 2 * len(element.properties), size + 1)
    for _ in range(element.count):
        file.readline(_LONGEST_LINE)


def _check_size(element: _Element, row: int, size: int) -> None:
    if element.count * max(row, 1) > size:
        raise MapError(
            f"the file is truncated: {element.count} x {element.name} take at least "
            f"{element.count * max(row, 1)} bytes, found {max(size, 0)}"
        )


def _binary(file: IO[bytes], element: _Element, order: str, size: int) -> NDArray[Any]:
    row_type = element.row_type(order, 0)
    _check_size(element, row_type.itemsize, size)
    if element.count and element.lists:
        start = file.tell()
        # Only the first length stands where this type has it; the others are compared below.
        head = np.frombuffer(file.read(row_type.itemsize), row_type)
        width = _checked_width(int(head[_LENGTH + element.lists[0].name][0]))
        file.seek(start)
        row_type = element.row_type(order, width)
        _check_size(element, row_type.itemsize, size)
    data = file.read(element.count * row_type.itemsize)
    if len(data) != element.count * row_type.itemsize:
        raise MapError("the file became shorter while it was read")
    table: NDArray[Any] = np.frombuffer(data, row_type)
    _check_lengths(table, element)
    return table


def _ascii(file: IO[bytes], element: _Element, order: str, size: int) -> NDArray[Any]:
    # Each number takes a character and a space, the last one perhaps no line end.
    _check_size(element, 2 * len(element.properties), size + 1)
    numbers = array.array("d")
    per_row = 0
    for index in range(element.count):
        line = file.readline(_LONGEST_LINE)
        try:
            numbers.extend(map(float, line.split()))
        except ValueError:
            text = line[:80].decode("ascii", "replace").strip()
            raise MapError(f"vertex {index + 1} is not a line of numbers: {text!r}") from None
        per_row = per_row or len(numbers)
        if not line or len(numbers) != (index + 1) * per_row:
            raise MapError(
                f"vertex {index + 1} of {element.count} must have {per_row} numbers, found "
                f"{len(numbers) - index * per_row}"
            )
    width = 0
    if element.lists and element.count:
        singles = len(element.properties)  # the lengths of the lists among them
        width = _checked_width((per_row - singles) // len(element.lists))
    row_type = element.row_type("<", width)
    expected = sum(math.prod(row_type[name].shape) for name in row_type.names or ())
    if element.count and expected != per_row:
        raise MapError(f"a vertex must have {expected} numbers, found {per_row}")
    values = np.frombuffer(numbers, np.float64).reshape(element.count, per_row)
    table = np.zeros(element.count, row_type)
    start = 0
    for name in row_type.names or ():
        kind = row_type[name]
        part = values[:, start : start + math.prod(kind.shape)]
        start += part.shape[1]
        if kind.base.kind in "iu":
            limits = np.iinfo(kind.base)
            if not np.all((part >= limits.min) & (part <= limits.max) & (part == np.floor(part))):
                raise MapError(f"{name} holds what is not a {_NAMES[kind.base.str[1:]]}")
        with np.errstate(over="ignore"):
            table[name] = part.reshape(element.count, *kind.shape)
    _check_lengths(table, element)
    return table


def _checked_width(width: int) -> int:
    if not 0 < width <= _LONGEST_LIST:
        raise MapError(f"a list must hold 1 to {_LONGEST_LIST} values, found {width}")
    return width


def _check_lengths(table: NDArray[Any], element: _Element) -> None:
    for item in element.lists if len(table) else ():
        lengths, width = table[_LENGTH + item.name], table.dtype[item.name].shape[0]
        if lengths.min() != width or lengths.max() != width:
            raise MapError(
                f"the lists {item.name} must be equally long, found {lengths.min()} to "
                f"{lengths.max()} values"
            )
