# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Numba's type of :mod:`rs_localizer.core.simd.vectors`, and its operations in LLVM."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing import templates
from numba.extending import intrinsic, lower_builtin, models, register_model

from rs_localizer.core.simd.tracing import LANES

# Numba has types, but not for these.
_get_or_insert_function: Any = cgutils.get_or_insert_function
_infer_global: Any = templates.infer_global
_lower_builtin: Any = lower_builtin
_make_model: Any = models.PrimitiveModel
_register_model: Any = register_model
_signature: Any = templates.signature

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_FLAGS = ("contract", "nsz", "arcp")  # as in simd.py: NaN keeps its meaning


class _Vector(types.Type):
    """Numba's name for ``LANES`` doubles in a register."""


_make_type: Any = _Vector
_vector = _make_type(name=f"vector{LANES}")
_register_model(_Vector)(lambda manager, kind: _make_model(manager, kind, _VECTOR))


def _inline(function: Callable[..., Any]) -> Any:
    # Any: for type checkers, kernels would otherwise miss an argument, the typing context.
    return intrinsic(function)


def _define(function: Any, instruction: str, operands: int) -> None:
    @_infer_global(function)
    class _Signature(templates.ConcreteTemplate):
        cases = [_signature(_vector, *[_vector] * operands)]  # noqa: RUF012  # numba's interface

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args, flags=_FLAGS)

    _lower_builtin(function, *[_Vector] * operands)(emit)


_define(operator.add, "fadd", 2)
_define(operator.sub, "fsub", 2)
_define(operator.mul, "fmul", 2)
_define(operator.truediv, "fdiv", 2)
_define(operator.neg, "fneg", 1)


def _element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(builder.bitcast(data, _VECTOR.as_pointer()), [index])


@_inline
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """Return the value ``index`` of an array."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        index = context.cast(builder, args[1], call.args[1], types.int64)
        return builder.load(_element(context, builder, call.args[0], args[0], index), align=8)

    return _vector(array, index), emit


@_inline
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write the value ``index`` of an array."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        index = context.cast(builder, args[1], call.args[1], types.int64)
        element = _element(context, builder, call.args[0], args[0], index)
        builder.store(args[2], element, align=8)
        return context.get_dummy_value()

    return types.void(array, index, value), emit


@_inline
def uniform(typingctx: Any, number: Any) -> Any:
    """Return a vector with one number in all lanes."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        lane = context.cast(builder, args[0], call.args[0], types.float64)
        value = ir.Constant(_VECTOR, ir.Undefined)
        for i in range(LANES):
            value = builder.insert_element(value, lane, ir.Constant(ir.IntType(32), i))
        return value

    return _vector(number), emit


def _unary(name: str) -> Any:
    @_inline
    def call(typingctx: Any, number: Any) -> Any:
        def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            function = _get_or_insert_function(builder.module, kind, f"{name}.v{LANES}f64")
            return builder.call(function, args)

        return _vector(number), emit

    return call


root = _unary("llvm.sqrt")  # NaN where negative
absolute = _unary("llvm.fabs")


@_inline
def where_less(typingctx: Any, left: Any, right: Any, if_true: Any, if_false: Any) -> Any:
    """Select ``if_true`` in lanes with left < right, and ``if_false`` in the others, NaN too."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return _vector(left, right, if_true, if_false), emit
