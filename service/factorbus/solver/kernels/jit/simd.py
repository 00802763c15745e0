"""Register tiles and runs of a float64 array, written in LLVM vectors: no compiler keeps a tile of a product in
registers by itself.

There are three sets of these functions with one meaning: `simd_llvm` (fast, no checks), `simd_checked` (the same
behind range checks, NUMBA_BOUNDSCHECK=1) and `simd_plain` (NumPy, NUMBA_DISABLE_JIT=1; read that one first).
"""

from factorbus.solver.kernels.jit.compile import BOUNDSCHECK, DISABLED, vector_lanes
from factorbus.solver.kernels.jit.simd_plain import Block, Panel

if DISABLED:
    from factorbus.solver.kernels.jit.simd_plain import add_run, six, solve_tile, tile, zero
elif BOUNDSCHECK:
    from factorbus.solver.kernels.jit.simd_checked import add_run, six, solve_tile, tile, zero
else:
    from factorbus.solver.kernels.jit.simd_llvm import add_run, six, solve_tile, tile, zero

__all__ = [
    "LANES",
    "TILE_ROWS",
    "TILE_VECTORS",
    "Block",
    "Panel",
    "add_run",
    "six",
    "solve_tile",
    "tile",
    "zero",
]

LANES = vector_lanes()
TILE_ROWS = 4
TILE_VECTORS = 3  # 4 x 3 sums, 3 loads and a broadcast: the 16 registers of AVX2
