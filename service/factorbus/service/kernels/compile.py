"""How these kernels are compiled: exactly, and keeping the interpreter lock.

`factorbus.solver.kernels.jit.compile` says how.

A call is done within a microsecond or two.  Were the lock given up for it, another thread could take it for half a
millisecond.
"""

import numpy as np
from numpy.typing import NDArray

from factorbus.solver.kernels.jit.compile import F64, I64, KernelFolder

__all__ = ["F64", "I64", "U8", "inline_kernel", "kernel", "part"]

U8 = NDArray[np.uint8]

_FOLDER = KernelFolder("kernels-wire", quick=True)
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
