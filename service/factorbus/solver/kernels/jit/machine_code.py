"""Functions that are made while a process runs: compiled from LLVM's language, and called by kernels by a number.

A kernel cannot know the address of such a function, and what is kept of a map must not hold one.  So a function has a
number that is the same in every process, and a table, at an address that kernels know by a name, says where it is.
"""

import ctypes
import functools
import weakref
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba.core.compiler_lock import global_compiler_lock

from factorbus.solver.kernels.jit.compile import DISABLED, inline_kernel, intrinsic, ir, types

# LLVM compiles for one thread at a time.
one_at_a_time = global_compiler_lock
_SLOTS = 1 << 16  # a power of 2
_FREE, _LEFT = 0, -1  # a slot that was never used, and one that was: a search goes on there
_NUMBER, _ADDRESS = 0, 1
_TABLE = np.zeros((_SLOTS, 2), np.int64)
_SYMBOL = "factorbus functions by number"

llvm.initialize_native_target()  # without Numba nobody else has
llvm.initialize_native_asmprinter()
llvm.add_symbol(_SYMBOL, _TABLE.ctypes.data)


class TooManyFunctions(RuntimeError):
    """The process has as many such functions as it can."""


class MachineCode:
    """A function that kernels can call by its number for as long as this is there."""

    def __init__(self, number: int, text: str, name: str) -> None:
        """The function `name` of the module `text`.  Raises TooManyFunctions."""
        with one_at_a_time:
            # Compiled apart: an engine that compiles keeps 0.8 MB, one that is given what is compiled 8 kB.
            compiled = _this_processor().emit_object(llvm.parse_assembly(text))
            self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _processor())
            self._engine.add_object_file(llvm.ObjectFileRef.from_data(compiled))
            self._engine.finalize_object()
            slot = _slot_for(number)
            _TABLE[slot, _ADDRESS] = self._engine.get_function_address(name)
            _TABLE[slot, _NUMBER] = number
        weakref.finalize(self, _leave, slot, self._engine).atexit = False


def _processor() -> Any:
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2
    )


# For all that is compiled, one at a time.
_this_processor = functools.cache(_processor)


def _slot_for(number: int) -> int:
    for k in range(_SLOTS):
        slot = (number + k) % _SLOTS
        if _TABLE[slot, _NUMBER] in (_FREE, _LEFT):
            return slot
    raise TooManyFunctions(f"this process has {_SLOTS} functions made of formulas")


def _leave(slot: int, engine: Any) -> None:
    with one_at_a_time:
        _TABLE[slot, _NUMBER] = _LEFT
        engine.close()


if DISABLED:

    def _first_of(array: Any, k: int) -> int:
        return int(array.ctypes.data) + 8 * k

    def _call(address: int, words: tuple[int, ...]) -> int:
        return int(ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * len(words))(address)(*words))

    def _word(k: int) -> int:
        return int(_TABLE.ravel()[k])

    def _as_number(bits: int) -> float:
        return float(np.int64(bits).view(np.float64))

    first_of: Any = _first_of
    call: Any = _call
    as_number: Any = _as_number
    word: Any = _word

else:
    _WORD = ir.IntType(64)

    @intrinsic
    def first_of(_typing: Any, array: Any, _k: Any) -> Any:
        """The address of the k-th entry of an array."""

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = context.make_array(signature.args[0])(context, builder, args[0]).data
            return builder.ptrtoint(builder.gep(data, [args[1]]), _WORD)

        return types.int64(array, types.int64), emit

    @intrinsic
    def call(_typing: Any, _address: Any, words: Any) -> Any:
        """The function at an address, called with a tuple of integers."""

        def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            kind = ir.FunctionType(_WORD, [_WORD] * words.count)
            given = [builder.extract_value(args[1], k) for k in range(words.count)]
            return builder.call(builder.inttoptr(args[0], kind.as_pointer()), given)

        return types.int64(types.int64, words), emit

    @intrinsic
    def as_number(_typing: Any, _bits: Any) -> Any:
        """The number that has these bits."""

        def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], ir.DoubleType())

        return types.float64(types.int64), emit

    @intrinsic
    def word(_typing: Any, _k: Any) -> Any:
        """The k-th number of the table."""

        def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            known = builder.module.globals.get(_SYMBOL) or ir.GlobalVariable(builder.module, _WORD, _SYMBOL)
            return builder.load(builder.gep(known, [args[0]]))

        return types.int64(types.int64), emit


@inline_kernel
def address_of_function(number: int) -> int:
    """Where the function with this number is; 0 where there is none."""
    slot = number % _SLOTS
    for _ in range(_SLOTS):
        there = word(2 * slot)
        if there == number:
            return word(2 * slot + 1)
        if there == _FREE:
            return 0
        slot = (slot + 1) % _SLOTS
    return 0
