"""Register tiles for covariances: products whose left factor may lie in another array, by rows or by columns.

So R is read where it is and nothing has to be transposed first.  Where the operands are is in `operands`.  As those of
`factorbus.solver.kernels.jit.simd` there are three sets of these functions with one meaning: `tiles_llvm`,
`tiles_checked` and `tiles_plain` (read that one first).
"""

from factorbus.solver.covariance.kernels.compile import BOUNDSCHECK, DISABLED

if DISABLED:
    from factorbus.solver.covariance.kernels.tiles_plain import (
        copy_runs,
        copy_vectors,
        negative_product,
        prefetch,
        solve_tile_lower,
        solve_tile_upper,
        subtract_product,
        transpose,
        transpose_negative,
    )
elif BOUNDSCHECK:
    from factorbus.solver.covariance.kernels.tiles_checked import (
        copy_runs,
        copy_vectors,
        negative_product,
        prefetch,
        solve_tile_lower,
        solve_tile_upper,
        subtract_product,
        transpose,
        transpose_negative,
    )
else:
    from factorbus.solver.covariance.kernels.tiles_llvm import (
        copy_runs,
        copy_vectors,
        negative_product,
        prefetch,
        solve_tile_lower,
        solve_tile_upper,
        subtract_product,
        transpose,
        transpose_negative,
    )

__all__ = [
    "RUN",
    "copy_runs",
    "copy_vectors",
    "negative_product",
    "prefetch",
    "solve_tile_lower",
    "solve_tile_upper",
    "subtract_product",
    "transpose",
    "transpose_negative",
]

RUN = 4  # doubles that `copy_runs` copies at a time
