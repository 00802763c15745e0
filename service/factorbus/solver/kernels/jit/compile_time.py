"""What Numba does in less time here: the code that it makes of our functions is the same."""

import functools
from typing import Any

import llvmlite.binding
from llvmlite.ir import Constant, instructions
from llvmlite.ir import types as types_of_llvm
from numba.core import base, errors, ir, lowering, typeinfer, types
from numba.core.compiler import Flags
from numba.core.compiler_machinery import PassManager
from numba.np import arrayobj

# Passes for what no kernel has.  They changed none of all functions that were compiled.
_FOR_OTHERS = {
    "DumpParforDiagnostics",
    "FindLiterallyCalls",
    "InlineClosureLikes",
    "InlineInlinables",
    "InlineOverloads",
    "LiteralPropagationSubPipelinePass",
    "LiteralUnroll",
    "MakeFunctionToJitFunction",
    "NoPythonSupportedFeatureValidation",
    "NopythonRewrites",  # of whole arrays in one expression
    "RewriteDynamicRaises",
    "WithLifting",
}


def keep_needed(pipeline: PassManager) -> None:
    """Leave out the passes for closures, `with`, `literal_unroll`, expressions of whole arrays and the like."""
    pipeline.passes = [(one, why) for one, why in pipeline.passes if one.__name__ not in _FOR_OTHERS]


class QuickFlags(Flags):
    """Numba's flags, compared in a tenth of the time: it looks all functions up by the flags they are called with."""

    __slots__ = ()
    _defaults = Flags().values()
    _hash = hash(Flags())

    def values(self) -> dict[str, Any]:
        return {**self._defaults, **self._values}

    def __hash__(self) -> int:
        return self._hash  # of the names alone, as numba has it


_find_call_type = types.BaseFunction.get_call_type


def _known_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """What a built-in function comes to with such arguments.  Numba finds that out anew at every call, and in every
    round of its inference; what was found once is known, which saves an eighth of the time that the step takes.
    """
    known = vars(self).setdefault("factorbus_known", {})
    asked = context, tuple(args), tuple(kws.items())
    if asked not in known:
        known[asked] = _find_call_type(self, context, args, kws)
    return known[asked]


types.BaseFunction.get_call_type = _known_call_type

_find_array_struct = arrayobj.make_array


@functools.cache
def _array_struct(kind: Any) -> Any:
    """How an array lies in memory: one class for each kind, where Numba makes one for every use of an array, and asks
    for the `__array__` of what is an array already."""
    found = _find_array_struct(kind)
    if type(kind) is types.Array and "_make_refs" in vars(found):  # else a copy of this file has done it
        del found._make_refs
    return found


arrayobj.make_array = _array_struct


def _list_variables(self: Any, val: Any) -> list[ir.Var]:
    """The variables in an instruction of Numba's, in their order, which it lists again in each of its passes."""
    if isinstance(val, dict):
        val = val.values()
    elif not isinstance(val, tuple | list):
        if isinstance(val, ir.Var):
            return [val]
        return val.list_vars() if isinstance(val, ir.Inst) else []
    found = []
    for one in val:
        kind = one.__class__
        if kind is ir.Var:
            found.append(one)
        elif kind not in _WITHOUT_VARIABLES:
            found += _list_variables(self, one)
    return found


_WITHOUT_VARIABLES = {ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg, str, int, bool, type(None)}
ir.Inst._rec_list_vars = _list_variables

# Whether a function takes a `loc` is asked anew for each use of it.
base._has_loc = functools.lru_cache(1024)(base._has_loc)


def _take_number(self: Any, name: str) -> None:
    """What an instruction is called in the text that LLVM reads: a number of its own within its function, where
    llvmlite looks for a name that is free and like the one it is given."""
    numbers = self.parent.scope._basenamemap
    numbers["="] += 1
    self._name = f"={numbers['=']}"  # no other name begins so


instructions.Instruction._set_name = _take_number


class _Context:
    """What an error of Numba's adds of where it came up, if one does.  Numba makes a generator for each."""

    __slots__ = ("_args", "_form", "_words")

    def __init__(self, form: str, *args: Any, **words: Any) -> None:
        self._form, self._args, self._words = form, args, words

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, problem: object, _trace: object) -> None:
        if isinstance(problem, errors.NumbaError):
            words = self._form  # which may have braces of its own
            if self._args or self._words:
                words = words.format(*self._args, **self._words)
            problem.add_context(words)


for _module in (errors, lowering, typeinfer):
    setattr(_module, "new_error_context", _Context)  # noqa: B010


def _constant(self: Any, value: Any) -> Constant:
    """A constant of a type.  llvmlite imports what that is in every call."""
    return Constant(self, value)


setattr(types_of_llvm.Type, "__call__", _constant)  # noqa: B010  (it is typed as what it was)

# While a function is being compiled each call of LLVM, and of all that are being compiled around it, would be timed.
llvmlite.binding.ffi.lib._lock._cblist.clear()
