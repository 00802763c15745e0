"""How many numbers the kinds have: values and tangents of variables, residuals and measurements of factors."""

from factorbus.solver.kernels.jit.compile import inline_kernel, part
from factorbus.solver.kernels.model import layout as at


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
    return other_dim(kind) if kind >= at.POSITION_SE2 else 2


@inline_kernel
def other_dim(kind: int) -> int:
    """The same of the kinds from POSITION_SE2 on."""
    if kind >= at.LINEAR_SE2:
        return linear_dim(kind)
    if kind == at.POSITION_SE3 or kind == at.ATTITUDE_SE3 or kind == at.BEARING_SE3:
        return 3
    return 2 if kind == at.POSITION_SE2 else 1


@inline_kernel
def information_at(kind: int) -> int:
    """Where in a factor's payload its information starts: the size of its measurement."""
    if kind >= at.POSITION_SE2:
        return other_size(kind)
    if kind >= at.IDP_FIRST:
        return 14 if kind == at.IDP_FIRST else 13
    return 7 if kind == at.BETWEEN_SE3 or kind == at.PRIOR_SE3 else residual_dim(kind)


@inline_kernel
def scale_at(kind: int) -> int:
    """Where in a factor's payload the scale of its loss is: behind its information."""
    dim = residual_dim(kind)
    return information_at(kind) + dim * (dim + 1) // 2


@inline_kernel
def other_size(kind: int) -> int:
    """Numbers measured by the kinds from POSITION_SE2 on."""
    if kind >= at.LINEAR_SE2:
        return linear_size(kind)
    if kind == at.POSITION_SE3 or kind == at.ATTITUDE_SE3:
        return 6
    return 4 if kind == at.POSITION_SE2 else other_dim(kind)


@part
def linear_dim(kind: int) -> int:
    """Rows of a linear factor: as many as the smaller of its variables has scalars."""
    first, second = linear_ends(kind)
    return dim_of(first) if second < 0 else min(dim_of(first), dim_of(second))


@part
def linear_size(kind: int) -> int:
    """Numbers of a linear factor: y of its variables, H of each, b."""
    first, second = linear_ends(kind)
    rows, numbers, columns = linear_dim(kind), size_of(first), dim_of(first)
    if second >= 0:
        numbers += size_of(second)
        columns += dim_of(second)
    return numbers + rows * (columns + 1)


@part
def linear_ends(kind: int) -> tuple:
    """`kinds_of_ends` of the kinds from LINEAR_SE2 on."""
    if kind < at.LINEAR_PAIR_SE2:
        return kind - at.LINEAR_SE2, -1
    if kind < at.LINEAR_PAIR_SE2_POINT2:
        return kind - at.LINEAR_PAIR_SE2, kind - at.LINEAR_PAIR_SE2
    if kind == at.LINEAR_PAIR_SE2_POINT2:
        return at.SE2, at.POINT2
    if kind == at.LINEAR_PAIR_SE3_POINT3:
        return at.SE3, at.POINT3
    return at.SE3 if kind == at.LINEAR_PAIR_SE3_IDP else at.POINT3, at.IDP


@inline_kernel
def kinds_of_ends(kind: int) -> tuple:
    """The kinds of variables that a kind of factor connects; −1: no second one."""
    if kind <= at.PRIOR_POINT3:
        return kind, -1
    if kind >= at.LINEAR_SE2:
        return linear_ends(kind)
    if kind == at.BETWEEN_SE2:
        return at.SE2, at.SE2
    if kind == at.BETWEEN_SE3:
        return at.SE3, at.SE3
    if kind == at.LANDMARK_SE3 or kind == at.POINT_SEEN or kind == at.RANGE_SE3 or kind == at.BEARING_SE3:
        return at.SE3, at.POINT3
    if kind == at.IDP_FIRST or kind == at.IDP_SEEN:
        return at.SE3, at.IDP
    if kind == at.POSITION_SE2 or kind == at.HEADING_SE2:
        return at.SE2, -1
    if kind == at.POSITION_SE3 or kind == at.ATTITUDE_SE3:
        return at.SE3, -1
    return at.SE2, at.POINT2


@inline_kernel
def end_dims(kind: int) -> tuple:
    """Scalars in the tangents of the ends of a kind of factor; 0: no second one."""
    first, second = kinds_of_ends(kind)
    return dim_of(first), dim_of(second) if second >= 0 else 0
