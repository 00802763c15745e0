"""Factors of one's own kinds: their instructions are carried out one by one.  MATH §3.11.

Forward mode: each value has behind it what it changes by for each scalar of the variables, which is the Jacobian of the
last of them.
"""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import expression_groups as groups
from factorbus.solver.kernels.model import expression_layout as at
from factorbus.solver.kernels.model import expression_vectors as vectors
from factorbus.solver.kernels.model.camera import INACTIVE_CHI2
from factorbus.solver.kernels.model.sizes import size_of

# A residual beyond it, or a slope, is no number to add to a sum of squares.
MOST_RESIDUAL = 1e12


@part
def evaluate_own(x: F64, kinds: I64, places: I64, p: F64, r: F64, J: F64) -> float:
    """r (dim,) and J (dim, Σ d) of a factor whose payload is p, as `expression_layout` has it.

    kinds, places (n,): of the variables, and where their values begin in x.  Where the residual is no number, or none
    that a square can be taken of, r and J are 0 and INACTIVE_CHI2 is given, which is added to χ²; else 0.
    """
    v, T = np.empty(int(p[at.X_VALUES])), np.zeros((J.shape[1], int(p[at.X_ROWS])))
    k = 0
    for n in range(kinds.size):
        for c in range(size_of(kinds[n])):
            v[k] = x[places[n] + c]
            k += 1
    for c in range(J.shape[1]):
        T[c, c] = 1.0
    length, count = int(p[at.X_LENGTH]), int(p[at.X_CONSTANTS])
    for c in range(length, int(p[at.X_BEFORE])):
        v[k] = p[c]
        k += 1
    for c in range(count):
        v[k] = p[at.HEAD + c]
        k += 1
    s, begin = np.empty(at.FIELDS, np.int64), at.HEAD + count
    for n in range(int(p[at.X_INSTRUCTIONS])):
        unpack(begin + at.WORDS * n, p, s)
        if s[at.OP] < _FIRST_OF_VECTORS:
            of_groups(s, v, T)
        else:
            of_vectors(s, v, T)
    return put_residual(p, v, T, r, J)


@inline_kernel
def unpack(k: int, p: F64, s: I64) -> None:
    """The fields of the instruction that is at p[k]."""
    first, second, third = int(p[k]), int(p[k + 1]), int(p[k + 2])
    place, scalar = (1 << at.PLACE_BITS) - 1, (1 << at.SCALAR_BITS) - 1
    s[at.OP], s[at.N] = first & ((1 << at.OP_BITS) - 1), first >> at.OP_BITS & ((1 << at.N_BITS) - 1)
    first >>= at.OP_BITS + at.N_BITS
    s[at.FIRST], s[at.LAST], s[at.OUT] = first & scalar, first >> at.SCALAR_BITS & scalar, first >> 2 * at.SCALAR_BITS
    s[at.ROW], s[at.A], s[at.A_ROW] = second & place, second >> at.PLACE_BITS & place, second >> 2 * at.PLACE_BITS
    s[at.B], s[at.B_ROW] = third & place, third >> at.PLACE_BITS


@part
def of_groups(s: I64, v: F64, T: F64) -> None:
    """One operation of rotations or poses."""
    operation = s[at.OP]
    if operation == _COMPOSE_SO3:
        groups.compose_so3(s, v, T)
    elif operation == _COMPOSE_SE2:
        groups.compose_pose2(s, v, T)
    elif operation == _COMPOSE_SE3:
        groups.compose_pose3(s, v, T)
    elif operation == _INVERSE_SO3:
        groups.inverse_so3(s, v, T)
    elif operation == _INVERSE_SE2:
        groups.inverse_pose2(s, v, T)
    elif operation == _INVERSE_SE3:
        groups.inverse_pose3(s, v, T)
    elif operation == _ROTATE_SE2:
        groups.rotate2(False, s, v, T)
    elif operation == _ACT_SE2:
        groups.rotate2(True, s, v, T)
    elif operation == _ROTATE_SO3:
        groups.rotate3(False, s, v, T)
    elif operation == _ACT_SE3:
        groups.rotate3(True, s, v, T)
    elif operation == _POSITION:
        groups.position(s, v, T)
    elif operation == _POSE_SE2:
        groups.pose2(s, v, T)
    elif operation == _POSE_SE3:
        groups.pose3(s, v, T)
    elif operation == _LOG:
        groups.log(s, v, T)
    elif operation == _EXP:
        groups.exp(s, v, T)
    else:
        groups.vector_part(s, v, T)


@part
def of_vectors(s: I64, v: F64, T: F64) -> None:
    """One operation of vectors and numbers."""
    operation = s[at.OP]
    if operation == _NORM:
        vectors.norm(s, v, T)
    elif operation == _DOT:
        vectors.dot(s, v, T)
    elif operation == _CROSS3:
        vectors.cross3(s, v, T)
    elif operation == _CROSS2:
        vectors.cross2(s, v, T)
    elif operation == _ATAN2:
        vectors.atan2(s, v, T)
    elif operation < _COPY:
        vectors.of_one(operation, s, v, T)
    elif operation == _COPY:
        vectors.copy(1.0, s, v, T)
    elif operation == _COPY_WHERE:
        if v[s[at.B]] >= 0.0:
            vectors.copy(1.0, s, v, T)
    elif operation == _ADD:
        vectors.add(1.0, s, v, T)
    elif operation == _SUBTRACT:
        vectors.add(-1.0, s, v, T)
    elif operation == _NEGATE:
        vectors.copy(-1.0, s, v, T)
    elif operation == _DIVIDE:
        vectors.divide(s, v, T)
    else:
        vectors.multiply_by(1 if operation == _MULTIPLY else 0, s, v, T)


@part
def put_residual(p: F64, v: F64, T: F64, r: F64, J: F64) -> float:
    """r and J of what the last instruction has given; gives what χ² has beside rᵀ Ω r."""
    value, row, is_number = int(p[at.X_RESIDUAL]), int(p[at.X_RESIDUAL_ROW]), True
    for a in range(len(J)):
        r[a] = v[value + a]
        is_number &= math.fabs(r[a]) <= MOST_RESIDUAL
        for c in range(J.shape[1]):
            J[a, c] = T[c, row + a]
            is_number &= math.fabs(J[a, c]) <= MOST_RESIDUAL
    if is_number:
        return 0.0
    r[: len(J)] = 0.0
    J[:] = 0.0
    return INACTIVE_CHI2


_FIRST_OF_VECTORS = at.CODES["norm"]
_COMPOSE_SO3, _COMPOSE_SE2, _COMPOSE_SE3 = (at.CODES[f"compose_{group}"] for group in ("so3", "se2", "se3"))
_INVERSE_SO3, _INVERSE_SE2, _INVERSE_SE3 = (at.CODES[f"inverse_{group}"] for group in ("so3", "se2", "se3"))
_ROTATE_SO3, _ROTATE_SE2, _ACT_SE2, _ACT_SE3 = (
    at.CODES[name] for name in ("rotate_so3", "rotate_se2", "act_se2", "act_se3")
)
_POSITION, _POSE_SE2, _POSE_SE3, _LOG, _EXP = (
    at.CODES[name] for name in ("position", "pose_se2", "pose_se3", "log", "exp")
)
_NORM, _DOT, _CROSS3, _CROSS2, _ATAN2 = (at.CODES[name] for name in ("norm", "dot", "cross3", "cross2", "atan2"))
_COPY, _COPY_WHERE, _ADD, _SUBTRACT = (at.CODES[name] for name in ("copy", "copy_where", "add", "subtract"))
_NEGATE, _MULTIPLY, _DIVIDE = (at.CODES[name] for name in ("negate", "multiply", "divide"))
