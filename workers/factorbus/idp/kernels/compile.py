"""How these kernels are compiled: as the solver's, but exactly (`factorbus.solver.kernels.jit.compile` says how).

The same features may be computed by any worker, whole or in shards, or in place.  With fused or reordered sums the
last bits would depend on where a loop was cut; without, only on the numbers.
"""

from factorbus.solver.kernels.jit.compile import DISABLED, F64, I64, KernelFolder, types

__all__ = ["DISABLED", "F64", "I64", "inline_kernel", "kernel", "part", "types"]

_FOLDER = KernelFolder("kernels-idp", exact=True)
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
