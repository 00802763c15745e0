"""Kernels that others call by their address, under a name that the linker finds: compiled once for all callers.

What a caller needs of one is its signature, which is declared with what it returns.  So a caller is compiled without
the code of what it calls, and stays as it is when that is edited.  Code that is run needs the address as well: the
machine code is compiled, or loaded, before any kernel of its folder is.  A process that compiles for others alone
(`only_compile`) runs none, and puts an address there that nothing may be called at.
"""

import ctypes
from collections.abc import Callable
from typing import Any

import llvmlite.binding
from numba.core.funcdesc import ExternalFunctionDescriptor
from numba.core.typing.templates import make_concrete_template

__all__ = ["SharedKernel", "compiles_for_others", "only_compile"]

_nowhere: list[int] = []


def only_compile() -> None:
    """This process runs no kernel from here on: those that are called by their address need not be there."""
    _nowhere[:] = [ctypes.cast(ctypes.CDLL(None).abort, ctypes.c_void_p).value or 0]


def compiles_for_others() -> bool:
    """Whether this process runs no kernel."""
    return bool(_nowhere)


class SharedKernel:
    """A kernel that others call by its address, which this process knows by the name that is in their code."""

    def __init__(self, dispatcher: Any, signature: Any, name: Callable[[], str], make: Callable[[Any], None]) -> None:
        """signature: with what it returns; make: has the machine code of the dispatcher compiled or loaded."""
        self._dispatcher, self._signature, self._name, self._make = dispatcher, signature, name, make
        self._called_by: Any = None
        self._template: Any = None
        self.is_being_made = False
        self._is_there = False
        dispatcher.factorbus_shared = True
        dispatcher.get_call_template = lambda args, _kws: (self._declared(), None, tuple(args), {})
        dispatcher.get_overload = lambda _signature: self._called_by

    def provide(self) -> None:
        """The name stands for the machine code."""
        if self._is_there:
            return
        if _nowhere:
            address = _nowhere[0]
        else:
            self.is_being_made = True
            try:
                self._make(self._dispatcher)
            finally:
                self.is_being_made = False
            (result,) = self._dispatcher.overloads.values()
            address = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
        llvmlite.binding.add_symbol(self._name(), address)
        self._is_there = True

    def _declared(self) -> Any:
        if self._template is None:
            name, kinds = self._name(), self._signature
            described = ExternalFunctionDescriptor(name, kinds.return_type, kinds.args)
            self._called_by, self._template = object(), make_concrete_template(name, key=name, signatures=[kinds])
            self._dispatcher.targetctx.insert_user_function(self._called_by, described)
        return self._template
