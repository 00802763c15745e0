"""How lenses are compiled: exactly, so that a feature has the same bits in every process.  No cache of their own."""

from factorbus.solver.kernels.jit.compile import F64, KernelFolder

__all__ = ["F64", "inline_kernel"]

inline_kernel = KernelFolder("lenses", exact=True).inline_kernel
