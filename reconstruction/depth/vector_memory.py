"""Loads and stores that the compiler may take apart from each other, so that a loop that looks things up is vectorized.

Numba's arrays may overlap for all that the compiler knows. A loop that reads at computed places and writes its result
then stays scalar: no check before the loop can exclude that it reads what it wrote. These two carry the promise that it
does not (LLVM's scoped aliasing). They check no bounds and take no negative indices.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _scope(builder):
    module = builder.module
    domain = module.add_metadata(["simrecon"])
    return module.add_metadata([module.add_metadata(["only read in this loop", domain])])


def _address(context, builder, signature, args):
    data = context.make_array(signature.args[0])(context, builder, args[0]).data
    return builder.gep(data, [args[1]])


@intrinsic
def load_only_read(typingctx, array, index):
    """Return array[index] of a contiguous 1-d array that `store_apart` does not write in the same loop."""

    def codegen(context, builder, signature, args):
        value = builder.load(_address(context, builder, signature, args))
        value.set_metadata("alias.scope", _scope(builder))
        return value

    return array.dtype(array, index), codegen


@intrinsic
def load_two(typingctx, array, index):
    """Return array[index] and array[index + 1] of a contiguous 1-d float32 array, as `load_only_read` does.

    Looked up together they cost half: what counts is the number of places, not of bytes.
    """

    def codegen(context, builder, signature, args):
        place = builder.bitcast(_address(context, builder, signature, args), ir.IntType(64).as_pointer())
        both = builder.load(place, align=4)
        both.set_metadata("alias.scope", _scope(builder))
        halves = (both, builder.lshr(both, ir.Constant(ir.IntType(64), 32)))
        values = [builder.bitcast(builder.trunc(half, ir.IntType(32)), ir.FloatType()) for half in halves]
        return context.make_tuple(builder, signature.return_type, values)

    return types.UniTuple(array.dtype, 2)(array, index), codegen


@intrinsic
def store_apart(typingctx, array, index, value):
    """Write array[index] = value of a contiguous 1-d array that `load_only_read` does not read in the same loop."""

    def codegen(context, builder, signature, args):
        store = builder.store(args[2], _address(context, builder, signature, args))
        store.set_metadata("noalias", _scope(builder))
        return context.get_dummy_value()

    return types.void(array, index, array.dtype), codegen
