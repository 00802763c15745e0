"""How these kernels are compiled: as the solver's, in a folder of their own.

`factorbus.solver.kernels.jit.compile` says how.

Of the solver's kernels they use how the tree lies in memory, records of arrays, and the loads and register tiles, no
more: an edit of anything else there does not compile these anew.
"""

from pathlib import Path

from factorbus.solver.kernels import jit
from factorbus.solver.kernels.jit.compile import BOUNDSCHECK, DISABLED, F64, I64, WIRE_KINDS, KernelFolder

__all__ = ["BOUNDSCHECK", "DISABLED", "F64", "I64", "inline_kernel", "kernel", "part"]

_KERNELS = Path(jit.__file__).parents[1]
_BORROWED = (
    *("model/layout", "bayes_tree/layout", "bayes_tree/records", "jit/array_table", "jit/records"),
    *("jit/simd", "jit/simd_llvm", "jit/simd_checked", "jit/simd_plain"),
)
_FOLDER = KernelFolder(
    Path(__file__).parent, "kernels-covariance", also=(*(_KERNELS / f"{name}.py" for name in _BORROWED), *WIRE_KINDS)
)
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
