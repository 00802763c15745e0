"""How these kernels are compiled: as the solver's, in a folder of their own.

`factorbus.solver.kernels.jit.compile` says how.
"""

from factorbus.solver.kernels.jit.compile import BOUNDSCHECK, DISABLED, F64, I64, KernelFolder

__all__ = ["BOUNDSCHECK", "DISABLED", "F64", "I64", "inline_kernel", "kernel", "part"]

_FOLDER = KernelFolder("kernels-covariance")
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
