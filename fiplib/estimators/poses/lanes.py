"""Sixteen numbers side by side in compiled code: a value of sixteen doubles, with + - * / and fused multiply-add.

The compiler vectorises a loop over lanes only if it can prove that no two arrays overlap, which it cannot for arrays
that were allocated elsewhere; such a loop then runs one lane at a time. A value that is a vector needs no proof.

``load`` and ``store`` move a row of an array (rows, 16) of float64, best of one from ``room``. A float64 beside a
vector stands for sixteen equal numbers. The operations round as IEEE 754 says, on every machine alike.
"""

import operator

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

WIDTH = 16
"""Lanes of a vector: as many as the free parameters of a flight need, one point and its fifteen neighbours."""

_DOUBLES = ir.VectorType(ir.DoubleType(), WIDTH)
_SPREAD = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)


class Vector(types.Type):
    """The type of sixteen doubles."""

    def __init__(self) -> None:
        super().__init__(name="Vector")


VECTOR = Vector()


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, _DOUBLES)


def _vectors(builder, signature, arguments):
    """The arguments as vectors: a double becomes sixteen equal ones."""
    for kind, value in zip(signature.args, arguments, strict=True):
        if kind != VECTOR:
            first = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, ir.IntType(32)(0))
            value = builder.shuffle_vector(first, ir.Constant(_DOUBLES, ir.Undefined), _SPREAD)
        yield value


def _fits(*kinds) -> bool:
    return VECTOR in kinds and all(kind in (VECTOR, types.float64) for kind in kinds)


def _define(symbol, instruction: str) -> None:
    """Let ``symbol`` work on two vectors, or on one and a double, by one instruction of LLVM."""

    @intrinsic
    def apply(context, first, second):
        def generate(context, builder, signature, arguments):
            return getattr(builder, instruction)(*_vectors(builder, signature, arguments))

        return VECTOR(first, second), generate

    @overload(symbol)
    def implementation(first, second):
        return (lambda first, second: apply(first, second)) if _fits(first, second) else None


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
_define(operator.truediv, "fdiv")


@intrinsic
def fma(context, factor, other, term):
    """Return factor * other + term, rounded once; at least one of them is a vector."""

    def generate(context, builder, signature, arguments):
        function = ir.FunctionType(_DOUBLES, [_DOUBLES] * 3)
        fused = cgutils.get_or_insert_function(builder.module, function, f"llvm.fma.v{WIDTH}f64")
        return builder.call(fused, list(_vectors(builder, signature, arguments)))

    return (VECTOR(factor, other, term), generate) if _fits(factor, other, term) else None


def _row(context, builder, kind, array, row):
    """The address of a row of an array."""
    array = context.make_array(kind)(context, builder, array)
    first = builder.gep(array.data, [builder.mul(row, ir.IntType(64)(WIDTH))])
    return builder.bitcast(first, _DOUBLES.as_pointer())


@intrinsic
def load(context, array, row):
    """Return a row of a contiguous array (rows, 16)."""

    def generate(context, builder, signature, arguments):
        value = builder.load(_row(context, builder, signature.args[0], *arguments))
        value.align = 8
        return value

    return VECTOR(array, types.int64), generate


@intrinsic
def store(context, array, row, value):
    """Write a row of a contiguous array (rows, 16)."""

    def generate(context, builder, signature, arguments):
        where = _row(context, builder, signature.args[0], *arguments[:2])
        (number,) = _vectors(builder, types.void(signature.args[2]), arguments[2:])
        builder.store(number, where).align = 8
        return context.get_dummy_value()

    return types.void(array, types.int64, value), generate


@numba.njit(cache=True)
def room(rows):
    """Return zeros (rows, 16) that begin at a line of the cache: a vector across two lines takes twice as long."""
    line = 64
    buffer = np.zeros(rows * WIDTH + line // 8)
    shift = (-buffer.ctypes.data % line) // 8
    return buffer[shift : shift + rows * WIDTH].reshape((rows, WIDTH))
