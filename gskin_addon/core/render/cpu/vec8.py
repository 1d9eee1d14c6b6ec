# SPDX-License-Identifier: GPL-3.0-or-later
"""Eight float32 lanes as one value inside numba kernels (LLVM `<8 x float>`; AVX, or two NEON registers).

numba's loop vectoriser gives up on the masks and the early exit of splat blending, and has no vector exp
without Intel's SVML. With these few operations a kernel says itself what runs in lanes: `+ - *` between two
Float8, `fma`, `select`, comparisons that give a Mask8, loads and stores on contiguous float32 arrays, and
`exp2`.

numba's on-disk cache does not look into this file: after a change here, touch the kernels' files as well.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.typing import templates
from numba.extending import models

# numba's decorators carry no types.
intrinsic: Any = extending.intrinsic
lower_builtin: Any = extending.lower_builtin
register_model: Any = extending.register_model
_templates: Any = templates
_insert_function: Any = cgutils.get_or_insert_function

LANES = 8

_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_F8 = ir.VectorType(_F32, LANES)
_I8 = ir.VectorType(_I32, LANES)
_M8 = ir.VectorType(ir.IntType(1), LANES)

# Minimax polynomial of 2^f on [-1/2, 1/2], lowest power first; relative error below 2e-7.
_EXP2 = (1.00000008, 0.69314719, 0.24022107, 0.05550357, 0.00967603, 0.00133909)


class Float8(types.Type):
    """numba type of eight float32 lanes."""

    def __init__(self) -> None:
        super().__init__(name="Float8")


class Mask8(types.Type):
    """numba type of eight booleans."""

    def __init__(self) -> None:
        super().__init__(name="Mask8")


float8: Any = Float8()
mask8: Any = Mask8()


@register_model(Float8)
class _Float8Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _F8)  # type: ignore[no-untyped-call]


@register_model(Mask8)
class _Mask8Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _M8)  # type: ignore[no-untyped-call]


def _vector(values: Any, kind: Any = _F8) -> Any:
    return ir.Constant(kind, list(values))


def _broadcast(builder: Any, scalar: Any) -> Any:
    one = builder.insert_element(ir.Constant(_F8, ir.Undefined), scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, ir.Constant(_F8, ir.Undefined), ir.Constant(_I8, [0] * LANES))


def _call(builder: Any, name: str, result: Any, *args: Any) -> Any:
    function_type = ir.FunctionType(result, [a.type for a in args])
    return builder.call(_insert_function(builder.module, function_type, name), args)


def _register(op: Any, emit: str) -> None:
    @_templates.infer_global(op)
    class _Binary(_templates.ConcreteTemplate):
        cases = [_templates.signature(float8, float8, float8)]

    @lower_builtin(op, float8, float8)
    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, emit)(*args, flags=("contract",))


for _op, _emit in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _register(_op, _emit)


@intrinsic
def broadcast(typingctx: Any, value: Any) -> Any:
    """float32 -> Float8 with the value in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(builder, context.cast(builder, args[0], sig.args[0], types.float32))

    return float8(value), codegen


@intrinsic
def lane_index(typingctx: Any) -> Any:
    """-> Float8 (0, 1, ..., 7)."""
    return float8(), lambda context, builder, sig, args: _vector(range(LANES))


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _F8.as_pointer())


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """(contiguous float32 array (n,), i) -> Float8 of array[i : i + 8]; bounds are not checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, sig.args[0], *args), align=4)

    return float8(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """(contiguous float32 array (n,), i, Float8): array[i : i + 8] = value; bounds are not checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, float8), codegen


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """(a, b, c) Float8 -> a * b + c, fused where the processor can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.fmuladd.v8f32", _F8, *args)

    return float8(float8, float8, float8), codegen


@intrinsic
def maximum(typingctx: Any, a: Any, b: Any) -> Any:
    """(Float8, Float8) -> lane-wise maximum."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return float8(float8, float8), codegen


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """(Float8, Float8) -> lane-wise minimum."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return float8(float8, float8), codegen


@intrinsic
def less(typingctx: Any, a: Any, b: Any) -> Any:
    """(Float8, Float8) -> Mask8, a < b."""
    return mask8(float8, float8), lambda context, builder, sig, args: builder.fcmp_ordered("<", *args)


@intrinsic
def both(typingctx: Any, a: Any, b: Any) -> Any:
    """(Mask8, Mask8) -> Mask8, a and b."""
    return mask8(mask8, mask8), lambda context, builder, sig, args: builder.and_(*args)


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """(Mask8, Float8, Float8) -> a where the mask holds, else b."""
    return float8(mask8, float8, float8), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Mask8 -> bool, whether any lane holds."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask8), codegen


def _reduce(builder: Any, v: Any, combine: Any) -> Any:
    undefined = ir.Constant(_F8, ir.Undefined)
    for step in (4, 2, 1):
        lanes = ir.Constant(_I8, [(i + step) % LANES for i in range(LANES)])
        v = combine(v, builder.shuffle_vector(v, undefined, lanes))
    return builder.extract_element(v, ir.Constant(_I32, 0))


@intrinsic
def lane_sum(typingctx: Any, v: Any) -> Any:
    """Float8 -> float32, the sum of the lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _reduce(builder, args[0], builder.fadd)

    return types.float32(float8), codegen


@intrinsic
def lane_max(typingctx: Any, v: Any) -> Any:
    """Float8 -> float32, the largest lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _reduce(builder, args[0], lambda a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))

    return types.float32(float8), codegen


@intrinsic
def exp2(typingctx: Any, x: Any) -> Any:
    """Float8 -> 2^x lane-wise for -126 < x < 127 (relative error 2e-7); other lanes hold any number."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        # Adding 1.5 * 2^23 leaves x rounded to an integer in the low bits of the mantissa.
        magic = _vector([12582912.0] * LANES)
        shifted = builder.fadd(args[0], magic)
        f = builder.fsub(args[0], builder.fsub(shifted, magic))
        p = _vector([_EXP2[-1]] * LANES)
        for coefficient in reversed(_EXP2[:-1]):
            p = _call(builder, "llvm.fmuladd.v8f32", _F8, p, f, _vector([coefficient] * LANES))
        exponent = builder.shl(builder.bitcast(shifted, _I8), _vector([23] * LANES, _I8))
        return builder.bitcast(builder.add(builder.bitcast(p, _I8), exponent), _F8)

    return float8(float8), codegen
