"""How many numbers the kinds have: values and tangents of variables, residuals and measurements of factors.

All of it is the wire's table, as arrays that are indexed by the code of a kind: constants in compiled code.
"""

import numpy as np

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import inline_kernel
from factorbus.solver.kernels.model import layout as at

_FACTORS, _VARIABLES = tuple(FACTOR_KINDS.values()), tuple(VARIABLE_KINDS.values())
MOST_ENDS = 4  # of a kind with a fixed number of variables
_SIZE = np.array([kind.size for kind in _VARIABLES], np.int64)
_DIM = np.array([kind.dim for kind in _VARIABLES], np.int64)
_QUATERNION_AT = np.array([kind.quaternion_at for kind in _VARIABLES], np.int64)
_SCALE_AT = np.array([kind.scale_at for kind in _VARIABLES], np.int64)
_IS_POSE = np.array([kind.is_pose for kind in _VARIABLES])
_IS_VECTOR = np.array([kind.is_vector for kind in _VARIABLES])
MOST_SCALARS = int(_DIM.max())  # of one variable: the size of the scratch that kernels have for it
# By the code of a kind of factor; the last are of members, and of families, whose sizes are each factor's own.
_NO_SIZE = (0,) * at.FURTHER_CODES
_RESIDUAL_DIM = np.array([*(kind.dim for kind in _FACTORS), *_NO_SIZE], np.int64)
_MEASURED = np.array([*(kind.size for kind in _FACTORS), *_NO_SIZE], np.int64)
_ARITY = np.array([*(len(kind.connects) for kind in _FACTORS), *_NO_SIZE], np.int64)
_ARITY[at.MEMBER] = 2
_ENDS = np.full((len(_FACTORS) + at.FURTHER_CODES, MOST_ENDS), -1, np.int64)
for _row, _kind in enumerate(_FACTORS):
    _ENDS[_row, : len(_kind.connects)] = [at.VARIABLE_CODES[end] for end in _kind.connects]
_END_DIMS = np.where(_ENDS >= 0, _DIM[_ENDS], 0)


@inline_kernel
def size_of(kind: int) -> int:
    """Numbers of a value of a kind of variable."""
    return _SIZE[kind]


@inline_kernel
def dim_of(kind: int) -> int:
    """Scalars in the tangent of a kind of variable."""
    return _DIM[kind]


@inline_kernel
def is_vector(kind: int) -> bool:
    """Whether a kind of variable is plain numbers, whose ⊞ is +."""
    return _IS_VECTOR[kind]


@inline_kernel
def is_pose(kind: int) -> bool:
    """Whether a kind of variable is a place and how something is turned there."""
    return _IS_POSE[kind]


@inline_kernel
def quaternion_of(kind: int) -> int:
    """Where in a value its quaternion begins; −1: it has none."""
    return _QUATERNION_AT[kind]


@inline_kernel
def scale_of(kind: int) -> int:
    """Where in a value its scale is; −1: it has none."""
    return _SCALE_AT[kind]


@inline_kernel
def has_own_sizes(kind: int) -> bool:
    """Whether the sizes of a kind of factor that may begin a factor are each factor's own: linear, own, inertial."""
    return kind >= at.LINEAR


@inline_kernel
def residual_dim(kind: int) -> int:
    """Numbers in the residual of a kind of factor."""
    return _RESIDUAL_DIM[kind]


@inline_kernel
def information_at(kind: int) -> int:
    """Where in a factor's payload its information starts: the size of its measurement."""
    return _MEASURED[kind]


@inline_kernel
def scale_at(kind: int) -> int:
    """Where in a factor's payload the scale of its loss is: behind its information."""
    dim = residual_dim(kind)
    return information_at(kind) + dim * (dim + 1) // 2


@inline_kernel
def arity_of(kind: int) -> int:
    """How many variables a kind of factor connects."""
    return _ARITY[kind]


@inline_kernel
def kind_of_end(kind: int, n: int) -> int:
    """The kind of the n-th variable that a kind of factor connects; −1: it has none."""
    return _ENDS[kind, n]


@inline_kernel
def kinds_of_ends(kind: int) -> tuple:
    """The kinds of the first two variables that a kind of factor connects; −1: no second one."""
    return _ENDS[kind, 0], _ENDS[kind, 1]


@inline_kernel
def end_dims(kind: int) -> tuple:
    """Scalars in the tangents of the first two ends of a kind of factor; 0: no second one."""
    return _END_DIMS[kind, 0], _END_DIMS[kind, 1]
