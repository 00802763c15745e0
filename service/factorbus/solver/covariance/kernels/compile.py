"""How these kernels are compiled: as the solver's (`factorbus.solver.kernels._jit` says how), in a folder of their own.

Of the solver's kernels they use how the tree lies in memory and the loads and register tiles, no more: an edit of
anything else there does not compile these anew.
"""

from pathlib import Path

from factorbus.solver.kernels import simd
from factorbus.solver.kernels._jit import BOUNDSCHECK, DISABLED, F64, I64, KernelFolder

__all__ = ["BOUNDSCHECK", "DISABLED", "F64", "I64", "inline_kernel", "kernel", "part"]

_BORROWED = ("layout", "tree_layout", "simd", "simd_llvm", "simd_checked", "simd_plain")
_FOLDER = KernelFolder(
    Path(__file__).parent,
    "kernels-covariance",
    also=tuple(Path(simd.__file__).with_name(f"{name}.py") for name in _BORROWED),
)
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
