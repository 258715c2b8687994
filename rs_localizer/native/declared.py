# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the arguments of an entry from its annotations, and check them when it is called.

An entry is declared by its annotations alone. ``Array2`` is a contiguous array of two dimensions,
``Out[Array2]`` one that the kernel writes to, a class that derives from ``NamedTuple`` stands for
its fields. The build turns a declaration into a line of text (:func:`encode`), which the native
module reads at each call; a call that does not fit is explained here, in whatever way kernels run.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple, NoReturn, get_args, get_origin

import numpy as np

CODES = {"float64": "d", "int64": "q", "bool": "?", "uint8": "B", "uint64": "Q", "float32": "f"}
"""How the buffer protocol writes the types of elements."""
_SCALARS = {float: "d", int: "q", bool: "?"}
WRITTEN = "written"
"""A mark in the annotation of an array: the kernel writes to it."""
_WORDS = {"d": "a float", "q": "an int", "?": "a bool"}


class Scalar(NamedTuple):
    """A float (``d``), an int (``q``) or a bool (``?``)."""

    code: str


class ArrayOf(NamedTuple):
    """A contiguous array."""

    element: str  # NumPy's name of the type
    dimensions: int
    is_written: bool = False


class TupleOf(NamedTuple):
    """A tuple, or a named tuple of one class."""

    fields: tuple[Any, ...]
    kind: Any = None  # the class


Kind = Scalar | ArrayOf | TupleOf


class Declaration(NamedTuple):
    """The name of an entry, and its arguments."""

    name: str  # with its module
    arguments: dict[str, Kind]


def declaration(function: Callable[..., Any]) -> Declaration:
    """Return what an entry takes, by its annotations.

    Raises:
        TypeError: an annotation that says too little, as ``Array`` without dimensions.
    """
    name = f"{function.__module__}.{function.__qualname__}"
    code = function.__code__
    if function.__defaults__ or code.co_kwonlyargcount:
        raise TypeError(f"{name}: an entry has neither defaults nor keywords")
    names, module = code.co_varnames[: code.co_argcount], function.__module__
    kinds = {each: _kind(function.__annotations__.get(each), module) for each in names}
    for each, kind in kinds.items():
        if kind is None:
            said = function.__annotations__.get(each)
            raise TypeError(f"{name}: {each}: {said!r} says too little of what an entry takes")
    return Declaration(name, kinds)  # type: ignore[arg-type]  # None was refused


def _kind(annotation: Any, module: str) -> Kind | None:
    """Return the kind of an annotation, or of its text in a module that postpones evaluation."""
    annotation = getattr(annotation, "__forward_arg__", annotation)  # of a named tuple's field
    if isinstance(annotation, str):
        annotation = eval(annotation, vars(importlib.import_module(module)))
    if get_origin(annotation) is Annotated:
        _, known, *more = get_args(annotation)
        return known._replace(is_written=WRITTEN in more) if isinstance(known, ArrayOf) else None
    if annotation in _SCALARS:
        return Scalar(_SCALARS[annotation])
    named = annotation if hasattr(annotation, "_fields") else None
    if named is not None:
        module = named.__module__
        fields = tuple(_kind(each, module) for each in named.__annotations__.values())
    elif get_origin(annotation) is tuple:
        fields = tuple(_kind(each, module) for each in get_args(annotation))
    else:
        return None
    return None if None in fields else TupleOf(fields, named)


def encode(kind: Kind, classes: list[Any]) -> str:
    """Encode one kind of argument for the native module; classes are numbered as they occur.

    A scalar is its code. An array is ``r`` or, where the kernel writes to it, ``w``, the code of
    its elements and its dimensions. A tuple is ``t``, the number of its class (two digits; 99 for
    a plain one) and of its fields (two digits), and these.
    """
    match kind:
        case Scalar(code):
            return code
        case ArrayOf(element, dimensions, is_written):
            return f"{'w' if is_written else 'r'}{CODES[element]}{dimensions}"
        case TupleOf(fields, None):
            number = 99
        case TupleOf(fields, named):
            if named not in classes:
                classes.append(named)
            number = classes.index(named)
    return f"t{number:02}{len(fields):02}" + "".join(encode(field, classes) for field in fields)


def refuse(declared: Declaration, arguments: Sequence[Any]) -> NoReturn:
    """Raise the error of a call that does not fit: kernel, argument, what is wanted and found.

    Raises:
        TypeError: always.
    """
    wanted = declared.arguments
    if len(arguments) != len(wanted):
        raise TypeError(f"{declared.name} takes {len(wanted)} arguments, got {len(arguments)}")
    for (name, kind), value in zip(wanted.items(), arguments, strict=True):
        if fault := _fault(kind, value):
            place, needed, found = fault
            raise TypeError(f"{declared.name}: {name}{place} must be {needed}, got {found}")
    raise TypeError(f"{declared.name}: its arguments do not fit")


def fits(declared: Declaration, arguments: Sequence[Any]) -> bool:
    """Return True if an entry takes these arguments."""
    return len(arguments) == len(declared.arguments) and not any(
        map(_fault, declared.arguments.values(), arguments)
    )


def _fault(kind: Kind, value: Any) -> tuple[str, str, str] | None:
    """Return where an argument is wrong, what is wanted there and what was found."""
    match kind:
        case Scalar(code):
            if not _is_scalar(code, value):
                return "", _WORDS[code], _found(value)
        case ArrayOf():
            if not _is_array(kind, value):
                return "", _wanted_array(kind), _found(value)
        case TupleOf(fields, named):
            of_class = type(value) is (named or tuple)
            if not of_class or len(value) != len(fields):
                wanted = named.__name__ if named else f"a tuple of {len(fields)}"
                return "", wanted, _found(value)
            names = named._fields if named else range(len(fields))
            for name, field, part in zip(names, fields, value, strict=True):
                if fault := _fault(field, part):
                    return (f".{name}" if named else f"[{name}]") + fault[0], *fault[1:]
    return None


def _is_scalar(code: str, value: Any) -> bool:
    if code == "d":
        return isinstance(value, float)
    if code == "q":
        is_int = isinstance(value, int | np.int64) and not isinstance(value, bool)
        return is_int and -(2**63) <= value < 2**63
    return isinstance(value, bool | np.bool_)


def _is_array(kind: ArrayOf, value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.dtype == np.dtype(kind.element)
        and value.ndim == kind.dimensions
        and value.flags.c_contiguous
        and value.flags.aligned
        and (value.flags.writeable or not kind.is_written)
    )


def _wanted_array(kind: ArrayOf) -> str:
    written = " that can be written to" if kind.is_written else ""
    return f"a contiguous array of {kind.element} with {kind.dimensions} dimensions{written}"


def _found(value: Any) -> str:
    if not isinstance(value, np.ndarray):
        return type(value).__name__
    flags = value.flags
    faults = [
        *([] if flags.c_contiguous else ["not contiguous"]),
        *([] if flags.aligned else ["not aligned"]),
        *([] if flags.writeable else ["read-only"]),
    ]
    said = f" ({', '.join(faults)})" if faults else ""
    return f"an array of {value.dtype} with {value.ndim} dimensions{said}"


FUNCTIONS: dict[str, Callable[..., Any]] = {}
"""The functions of the entries that run natively, by name."""


def refuse_call(name: str, arguments: Sequence[Any]) -> NoReturn:
    """Refuse a call of a native entry, see :func:`refuse`; the native module calls this.

    Raises:
        TypeError: always.
    """
    refuse(declaration(FUNCTIONS[name]), arguments)
