# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Entries: what Python may call a kernel with, and what becomes of the answer."""

import gc
import importlib
import os
import pickle
import subprocess
import sys
import typing

import numpy as np
import pytest

from rs_localizer import native
from rs_localizer.core import so3
from rs_localizer.native import declared, sources
from rs_localizer.native.declared import ArrayOf, Scalar, TupleOf

JITTED = native.COMPILES


def entries():
    """All entries of the package by name: what Python calls."""
    for module in sources.kernel_modules():
        importlib.import_module(module)
    if not JITTED:
        return declared.FUNCTIONS
    from rs_localizer.native import jit

    return {name: entry.py_func for name, entry in jit.ENTRIES.items()}


def entry(name):
    module, _, function = name.rpartition(".")
    return getattr(sys.modules[module], function)


ENTRIES = entries()


def some(kind):
    """An argument that an entry takes by its declaration, as small as can be."""
    match kind:
        case Scalar(code):
            return {"d": 0.5, "q": 1, "?": True}[code]
        case ArrayOf(element, dimensions):
            return np.zeros((1,) * dimensions, element)
        case TupleOf(fields, named):
            return (named or (lambda *parts: parts))(*map(some, fields))


def faults_of(kind):
    """Arguments that an entry must refuse instead, and a word of what it says."""
    match kind:
        case Scalar("d"):
            yield from [(1, "a float"), (np.float32(1.0), "a float"), (None, "a float")]
        case Scalar("q"):
            yield from [(1.0, "an int"), (True, "an int"), (2**63, "an int"), ("1", "an int")]
        case Scalar():
            yield from [(1, "a bool"), (np.float64(1.0), "a bool")]
        case ArrayOf(element, dimensions, is_written):
            other = "float32" if element == "float64" else "float64"
            yield np.zeros((1,) * dimensions, other), element
            yield np.zeros((1,) * (dimensions + 1), element), f"{dimensions} dimensions"
            every_second = (slice(None, None, 2),) * dimensions
            yield np.zeros((4,) * dimensions, element)[every_second], "contiguous"
            yield [0.0], "a contiguous array"
            size = np.dtype(element).itemsize
            if size > 1:
                raw = np.zeros(size + 1, np.uint8)[1:].view(element)
                yield raw.reshape((1,) * dimensions), "not aligned"
            if is_written:
                fixed = np.zeros((1,) * dimensions, element)
                fixed.flags.writeable = False
                yield fixed, "can be written to"
        case TupleOf(fields, named):
            yield 1, named.__name__ if named else "a tuple"
            parts = tuple(map(some, fields))
            yield parts[:-1], named.__name__ if named else "a tuple"
            if named is not None:
                yield parts, named.__name__
            for k, field in enumerate(fields):
                for fault, word in faults_of(field):
                    replaced = (*parts[:k], fault, *parts[k + 1 :])
                    yield (named._make(replaced) if named else replaced), word


@pytest.mark.parametrize("name", sorted(ENTRIES))
def test_an_entry_refuses_what_it_does_not_declare(name):
    said = declared.declaration(ENTRIES[name])
    arguments = [some(kind) for kind in said.arguments.values()]
    with pytest.raises(TypeError, match=f"takes {len(arguments)} arguments"):
        entry(name)(*arguments, 1.0)
    for k, (argument, kind) in enumerate(said.arguments.items()):
        for fault, word in faults_of(kind):
            with pytest.raises(TypeError) as refused:
                entry(name)(*arguments[:k], fault, *arguments[k + 1 :])
            text = str(refused.value)
            assert text.startswith(f"{name}: {argument}"), text
            assert word in text, text
            assert "got" in text


def test_a_kernel_that_is_no_entry_is_not_called():
    with pytest.raises(TypeError, match=r"so3\.coefficients is called by kernels alone"):
        so3.coefficients(0.1)


def test_a_read_only_array_is_taken_where_nothing_is_written():
    vector = np.array([0.1, 0.2, 0.3])
    expected = so3.exp(vector)
    vector.flags.writeable = False
    np.testing.assert_array_equal(so3.exp(vector), expected)


def test_refusals_do_not_leak():
    held = np.zeros(3, np.float32)
    before = sys.getrefcount(held)
    for _ in range(100):
        with pytest.raises(TypeError):
            so3.exp(held)
    gc.collect()
    assert sys.getrefcount(held) == before


@pytest.mark.skipif(JITTED, reason="of the native module")
def test_an_entry_is_pickled_by_its_name():
    again = pickle.loads(pickle.dumps(so3.exp))
    np.testing.assert_array_equal(again(np.ones(3)), so3.exp(np.ones(3)))
    assert "core.so3.exp" in repr(so3.exp.__self__)


class Pair(typing.NamedTuple):
    one: float
    two: "np.ndarray"


def odd(x: np.ndarray) -> None: ...
def pair(x: Pair) -> None: ...
def defaults(x: float = 0.0) -> None: ...


@pytest.mark.parametrize(
    ("function", "said"),
    [(odd, "x: .*says too little"), (pair, "x: .*says too little"), (defaults, "neither defaults")],
)
def test_an_annotation_that_says_too_little_is_refused(function, said):
    with pytest.raises(TypeError, match=said):
        declared.declaration(function)


@pytest.mark.parametrize(
    ("cap", "said"),
    [("v9", "'v9'; this machine's levels are v2, v3, v4"), ("generic", "levels are")],
)
def test_a_level_that_is_none_is_refused_in_a_line(cap, said):
    environment = os.environ | {"RS_LOCALIZER_LEVEL": cap}
    environment.pop("RS_LOCALIZER_KERNELS", None)
    code = "from rs_localizer.core import so3"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert done.returncode != 0
    assert said in done.stderr.splitlines()[-1]
