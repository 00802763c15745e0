"""How lenses are compiled: exactly, so that a feature has the same bits in every process.  No cache of their own."""

from pathlib import Path

from factorbus.solver.kernels.jit.compile import F64, KernelFolder

__all__ = ["F64", "FOLDER", "inline_kernel"]

FOLDER = Path(__file__).parent
inline_kernel = KernelFolder(FOLDER, "lenses", exact=True).inline_kernel
