"""SIMD values in ordinary Numba code: loops where tracing would unroll too much.

:mod:`rs_localizer.core.simd` unrolls a small solver into straight-line code. Elimination and
eigenvalues of 20x20 matrices take tens of thousands of operations and need loops. Here Numba
gets one type whose values hold ``LANES`` doubles, one per sample, in one LLVM vector; kernels
load, combine and store such values as they would numbers.

Arrays are flat float64 arrays with ``LANES`` doubles per value, as :func:`simd.traced` has them.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from rs_localizer.core.jit import kernel
from rs_localizer.core.simd import LANES
from rs_localizer.core.so3 import Array

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_FLAGS = ("contract", "nsz", "arcp")  # as in simd.py: NaN keeps its meaning


class _Vector(types.Type):  # type: ignore[misc]  # numba has no types
    def __init__(self) -> None:
        super().__init__(name=f"vector{LANES}")


_vector = _Vector()


@register_model(_Vector)  # type: ignore[untyped-decorator]
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _define(function: Any, instruction: str, operands: int) -> None:
    @infer_global(function)  # type: ignore[untyped-decorator]
    class _Signature(ConcreteTemplate):  # type: ignore[misc]
        cases = [signature(_vector, *[_vector] * operands)]  # noqa: RUF012  # numba's interface

    @lower_builtin(function, *[_Vector] * operands)  # type: ignore[untyped-decorator]
    def _emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args, flags=_FLAGS)


_define(operator.add, "fadd", 2)
_define(operator.sub, "fsub", 2)
_define(operator.mul, "fmul", 2)
_define(operator.truediv, "fdiv", 2)
_define(operator.neg, "fneg", 1)


def _element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(builder.bitcast(data, _VECTOR.as_pointer()), [index])


@intrinsic  # type: ignore[untyped-decorator]
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """The value ``index`` of an array."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        index = context.cast(builder, args[1], call.args[1], types.int64)
        return builder.load(_element(context, builder, call.args[0], args[0], index), align=8)

    return _vector(array, index), emit


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Write the value ``index`` of an array."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        index = context.cast(builder, args[1], call.args[1], types.int64)
        element = _element(context, builder, call.args[0], args[0], index)
        builder.store(args[2], element, align=8)
        return context.get_dummy_value()

    return types.void(array, index, value), emit


@intrinsic  # type: ignore[untyped-decorator]
def uniform(typingctx: Any, number: Any) -> Any:
    """The same number in all lanes."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        lane = context.cast(builder, args[0], call.args[0], types.float64)
        value = ir.Constant(_VECTOR, ir.Undefined)
        for i in range(LANES):
            value = builder.insert_element(value, lane, ir.Constant(ir.IntType(32), i))
        return value

    return _vector(number), emit


@intrinsic  # type: ignore[untyped-decorator]
def root(typingctx: Any, number: Any) -> Any:
    """Square root; NaN where negative."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        function = get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR]), f"llvm.sqrt.v{LANES}f64"
        )
        return builder.call(function, args)

    return _vector(number), emit


@intrinsic  # type: ignore[untyped-decorator]
def where_less(typingctx: Any, left: Any, right: Any, if_true: Any, if_false: Any) -> Any:
    """Lane by lane ``if_true`` where left < right, else (NaN too) ``if_false``."""

    def emit(context: Any, builder: Any, call: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return _vector(left, right, if_true, if_false), emit


@kernel
def lane_array(count: int) -> Array:
    """A new array of ``count`` values that begin at cache lines: no load touches two of them."""
    raw: Array = np.zeros((count + 1) * LANES)
    skip = (-raw.ctypes.data // 8) % LANES
    return raw[skip : skip + count * LANES]
