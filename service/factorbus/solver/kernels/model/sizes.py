"""How many numbers the kinds have: values and tangents of variables, residuals and measurements of factors.

All of it is the wire's table, as arrays that are indexed by the code of a kind: constants in compiled code.
"""

import numpy as np

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import inline_kernel
from factorbus.solver.kernels.model import layout as at

_FACTORS, _VARIABLES = tuple(FACTOR_KINDS.values()), tuple(VARIABLE_KINDS.values())
_SIZE = np.array([kind.size for kind in _VARIABLES], np.int64)
_DIM = np.array([kind.dim for kind in _VARIABLES], np.int64)
_RESIDUAL_DIM = np.array([kind.dim for kind in _FACTORS], np.int64)
_MEASURED = np.array([kind.size for kind in _FACTORS], np.int64)
_FIRST = np.array([at.VARIABLE_CODES[kind.connects[0]] for kind in _FACTORS], np.int64)
_SECOND = np.array([at.VARIABLE_CODES[kind.connects[1]] if kind.connects[1:] else -1 for kind in _FACTORS], np.int64)
_FIRST_DIM = _DIM[_FIRST]
_SECOND_DIM = np.where(_SECOND >= 0, _DIM[_SECOND], 0)
_LINEARIZED = _SIZE[_FIRST] + np.where(_SECOND >= 0, _SIZE[_SECOND], 0)


@inline_kernel
def size_of(kind: int) -> int:
    """Numbers of a value of a kind of variable."""
    return _SIZE[kind]


@inline_kernel
def dim_of(kind: int) -> int:
    """Scalars in the tangent of a kind of variable."""
    return _DIM[kind]


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
def kinds_of_ends(kind: int) -> tuple:
    """The kinds of variables that a kind of factor connects; −1: no second one."""
    return _FIRST[kind], _SECOND[kind]


@inline_kernel
def end_dims(kind: int) -> tuple:
    """Scalars in the tangents of the ends of a kind of factor; 0: no second one."""
    return _FIRST_DIM[kind], _SECOND_DIM[kind]


@inline_kernel
def values_of_ends(kind: int) -> int:
    """Numbers of the values of the ends of a kind of factor together."""
    return _LINEARIZED[kind]
