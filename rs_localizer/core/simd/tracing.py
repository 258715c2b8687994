# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Straight-line SIMD code for Numba, written as plain Python arithmetic.

A minimal solver is a few hundred multiplications on a system of fixed size, needed for thousands
of samples. A call of :func:`traced` turns a Python function on numbers into a function for kernels
that works on ``LANES`` samples at once. The Python function runs once, at compile time, on
:class:`Lanes` objects, which record every operation as one LLVM vector instruction. This unrolls
loops over rows and columns; intermediate matrices live in registers and on the stack. Values of the
lanes never mix, and a structural zero (the Python number 0.0) costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Union

from rs_localizer.native import COMPILES

LANES = 8  # one AVX-512 register of doubles; narrower machines split it

if COMPILES:
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

    _VECTOR = ir.VectorType(ir.DoubleType(), LANES)
    _get_or_insert_function: Any = cgutils.get_or_insert_function
    _alloca_once: Any = cgutils.alloca_once

_FLAGS = ("contract", "nsz", "arcp")  # a*b + c may fuse; NaN and infinity keep their meaning

Number = Union["Lanes", float]


class Lanes:
    """One double per lane, as a value in the LLVM code being built."""

    __slots__ = ("builder", "value")

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder = builder
        self.value = value

    def _apply(self, name: str, left: Any, right: Any) -> Lanes:
        return Lanes(self.builder, getattr(self.builder, name)(left, right, flags=_FLAGS))

    def __add__(self, other: Number) -> Lanes:
        if _is_number(other, 0.0):
            return self
        return self._apply("fadd", self.value, _operand(other))

    __radd__ = __add__

    def __sub__(self, other: Number) -> Lanes:
        if _is_number(other, 0.0):
            return self
        return self._apply("fsub", self.value, _operand(other))

    def __rsub__(self, other: Number) -> Lanes:
        if _is_number(other, 0.0):
            return -self
        return self._apply("fsub", _operand(other), self.value)

    def __mul__(self, other: Number) -> Any:
        if _is_number(other, 0.0):
            return 0.0
        if _is_number(other, 1.0):
            return self
        return self._apply("fmul", self.value, _operand(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Lanes:
        return self._apply("fdiv", self.value, _operand(other))

    def __rtruediv__(self, other: Number) -> Lanes:
        return self._apply("fdiv", _operand(other), self.value)

    def __neg__(self) -> Lanes:
        return Lanes(self.builder, self.builder.fneg(self.value))

    def __abs__(self) -> Lanes:
        return self._call("llvm.fabs")

    def __lt__(self, other: Number) -> Mask:
        return self._compare("<", other)

    def __gt__(self, other: Number) -> Mask:
        return self._compare(">", other)

    def _compare(self, relation: str, other: Number) -> Mask:
        value = self.builder.fcmp_ordered(relation, self.value, _operand(other))
        return Mask(self.builder, value)

    def _call(self, name: str) -> Lanes:
        function = _get_or_insert_function(
            self.builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"{name}.v{LANES}f64"
        )
        return Lanes(self.builder, self.builder.call(function, [self.value]))

    def _sqrt(self) -> Lanes:
        return self._call("llvm.sqrt")


class Mask:
    """One truth value per lane; comparisons with NaN are false."""

    __slots__ = ("builder", "value")

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder = builder
        self.value = value

    def __and__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.and_(self.value, other.value))


def sqrt(number: Any) -> Any:
    """Return the square root of lanes (NaN where negative) or of a number."""
    return number._sqrt() if isinstance(number, Lanes) else math.sqrt(number)


def select(condition: Any, if_true: Any, if_false: Any) -> Any:
    """Select one of two values, lane by lane; a plain truth value selects for all lanes."""
    if not isinstance(condition, Mask):
        return if_true if condition else if_false
    chosen = condition.builder.select(condition.value, _operand(if_true), _operand(if_false))
    return Lanes(condition.builder, chosen)


def _operand(number: Number) -> Any:
    if isinstance(number, Lanes):
        return number.value
    return ir.Constant(_VECTOR, [float(number)] * LANES)


def _is_number(value: Any, number: float) -> bool:
    return not isinstance(value, Lanes) and value == number


def traced(body: Callable[[list[Lanes]], Sequence[Number]], *inputs: int) -> Any:
    """Make a Numba-callable ``function(source, ..., target)`` of straight-line arithmetic.

    Args:
        body: takes a list of lanes, returns the outputs; plain Python arithmetic.
        inputs: how many values each source holds; the body gets them in one list.

    Returns:
        a function for use inside kernels; sources and target are flat float64 arrays of ``LANES``
        doubles per value. The target may be one of the sources: all is read before any write.
        None where kernels come compiled.
    """
    if not COMPILES:
        return None

    def compile_call(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def element(argument: int, i: int) -> Any:
            array = context.make_array(signature.args[argument])(context, builder, args[argument])
            base = builder.bitcast(array.data, _VECTOR.as_pointer())
            return builder.gep(base, [ir.Constant(ir.IntType(64), i)])

        lanes = [
            Lanes(builder, builder.load(element(argument, i), align=8))
            for argument, count in enumerate(inputs)
            for i in range(count)
        ]
        for i, number in enumerate(body(lanes)):
            builder.store(_operand(number), element(len(inputs), i), align=8)
        return context.get_dummy_value()

    # Numba reads the number of arguments off the function that it is given.
    @intrinsic
    def one_source(typingctx: Any, source: Any, target: Any) -> Any:
        return types.void(source, target), compile_call

    @intrinsic
    def two_sources(typingctx: Any, source: Any, uniform: Any, target: Any) -> Any:
        return types.void(source, uniform, target), compile_call

    return one_source if len(inputs) == 1 else two_sources


def traced_sums(inputs: int, *bodies: tuple[Callable[[list[Lanes]], Sequence[Number]], int]) -> Any:
    """Make a Numba-callable ``function(source, blocks, target)`` of sums over points.

    Args:
        inputs: how many values a block of the source holds.
        bodies: each takes a list of lanes and returns terms, as in :func:`traced`, and how many it
            returns. It goes through all blocks on its own, with its sums in registers, so it should
            not return more than 20.

    Returns:
        a function for use inside kernels: the target gets one number for each term of each body,
        its sum over all lanes of the first ``blocks`` blocks.
    """
    if not COMPILES:
        return None

    @intrinsic
    def sums(typingctx: Any, source: Any, blocks: Any, target: Any) -> Any:
        def compile_call(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            source_data, target_data = (_data(context, builder, signature, args, i) for i in (0, 2))
            for body, count in bodies:
                _sum_over(builder, (source_data, inputs), args[1], body, count, target_data)
                target_data = builder.gep(target_data, [ir.Constant(ir.IntType(64), count)])
            return context.get_dummy_value()

        return types.void(source, blocks, target), compile_call

    return sums


def _data(context: Any, builder: Any, signature: Any, args: Any, argument: int) -> Any:
    array = context.make_array(signature.args[argument])(context, builder, args[argument])
    return array.data


def _sum_over(
    builder: Any, source: tuple[Any, int], blocks: Any,
    body: Callable[[list[Lanes]], Sequence[Number]], count: int, target: Any,
) -> None:  # fmt: skip
    """Sum the terms of a body over all lanes of the first blocks of this many values each."""
    totals = [_alloca_once(builder, _VECTOR) for _ in range(count)]
    for total in totals:
        builder.store(_operand(0.0), total)
    with cgutils.for_range(builder, blocks) as loop:
        data, inputs = source
        offset = builder.mul(loop.index, ir.Constant(loop.index.type, inputs))
        base = builder.gep(builder.bitcast(data, _VECTOR.as_pointer()), [offset])
        lanes = []
        for i in range(inputs):
            value = builder.gep(base, [ir.Constant(ir.IntType(64), i)])
            lanes.append(Lanes(builder, builder.load(value, align=8)))
        for total, term in zip(totals, body(lanes), strict=True):
            so_far = Lanes(builder, builder.load(total))
            builder.store(_operand(so_far + term), total)
    for index, total in enumerate(totals):
        scalar = _across_lanes(builder, builder.load(total))
        element = builder.gep(target, [ir.Constant(ir.IntType(64), index)])
        builder.store(scalar, element)


def _across_lanes(builder: Any, vector: Any) -> Any:
    double = ir.DoubleType()
    function = _get_or_insert_function(
        builder.module,
        ir.FunctionType(double, [double, _VECTOR]),
        f"llvm.vector.reduce.fadd.v{LANES}f64",
    )
    return builder.call(function, [ir.Constant(double, 0.0), vector], fastmath=("reassoc",))


# -- small fixed-size linear algebra on lanes (or on anything with the same operators) ---------

Vector = list[Any]
