"""How these kernels are compiled: exactly, and keeping the interpreter lock.

`factorbus.solver.kernels.jit.compile` says how.

A call is done within a microsecond or two.  Were the lock given up for it, another thread could take it for half a
millisecond.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorbus.solver.kernels import jit
from factorbus.solver.kernels.jit.compile import F64, I64, WIRE_KINDS, KernelFolder

__all__ = ["F64", "I64", "U8", "inline_kernel", "kernel", "part"]

U8 = NDArray[np.uint8]

_KERNELS = Path(jit.__file__).parents[1]
_BORROWED = ("model/layout", "model/records", "graph/group_table", "jit/array_table", "jit/records")
_ALSO = (*(_KERNELS / f"{name}.py" for name in _BORROWED), *WIRE_KINDS)
_FOLDER = KernelFolder(Path(__file__).parent, "kernels-wire", quick=True, also=_ALSO)
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
