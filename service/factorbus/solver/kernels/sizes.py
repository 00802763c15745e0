"""How many numbers the kinds have: values and tangents of variables, residuals and measurements of factors."""

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import inline_kernel


@inline_kernel
def size_of(kind: int) -> int:
    """Numbers of a value of a kind of variable."""
    if kind == at.SE3:
        return 7
    if kind == at.IDP:
        return 6
    return 2 if kind == at.POINT2 else 3


@inline_kernel
def dim_of(kind: int) -> int:
    """Scalars in the tangent of a kind of variable."""
    if kind == at.SE3 or kind == at.IDP:
        return 6
    return 2 if kind == at.POINT2 else 3


@inline_kernel
def residual_dim(kind: int) -> int:
    """Numbers in the residual of a kind of factor."""
    if kind == at.BETWEEN_SE2 or kind == at.PRIOR_SE2 or kind == at.LANDMARK_SE3 or kind == at.PRIOR_POINT3:
        return 3
    if kind == at.BETWEEN_SE3 or kind == at.PRIOR_SE3 or kind == at.IDP_FIRST:
        return 6
    return 2


@inline_kernel
def information_at(kind: int) -> int:
    """Where in a factor's payload its information starts: the size of its measurement."""
    if kind >= at.IDP_FIRST:
        return 14 if kind == at.IDP_FIRST else 13
    return 7 if kind == at.BETWEEN_SE3 or kind == at.PRIOR_SE3 else residual_dim(kind)


@inline_kernel
def scale_at(kind: int) -> int:
    """Where in a factor's payload the scale of its loss is: behind its information."""
    dim = residual_dim(kind)
    return information_at(kind) + dim * (dim + 1) // 2
