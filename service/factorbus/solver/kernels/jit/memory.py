"""Numbers at any address: a kernel reads columns in a message where they lie.  They need not be aligned.

Whoever passes an address keeps what is there.
"""

import ctypes
from typing import Any

from factorbus.solver.kernels.jit.compile import DISABLED, intrinsic, ir, types

int_at: Any
float_at: Any

if DISABLED:

    def _int_at(address: int) -> int:
        """The int64 at the address."""
        return ctypes.c_int64.from_address(int(address)).value

    def _float_at(address: int) -> float:
        """The float64 at the address."""
        return ctypes.c_double.from_address(int(address)).value

    int_at, float_at = _int_at, _float_at

else:

    def _reader(kind: Any, model: Any) -> Any:
        @intrinsic
        def found(_typing: Any, _address: Any) -> Any:
            """The number at the address."""

            def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
                return builder.load(builder.inttoptr(args[0], model.as_pointer()), align=1)

            return kind(types.int64), emit

        return found

    int_at, float_at = _reader(types.int64, ir.IntType(64)), _reader(types.float64, ir.DoubleType())
