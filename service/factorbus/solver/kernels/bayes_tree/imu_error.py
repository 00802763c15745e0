"""χ² and the linearization error of a factor of an IMU's samples, whose Ω is one and which has no loss.  MATH (9.11)

As `exact_error_of_many`, but nothing is whitened that does not have to be: with r = W ρ, of the Jacobian W P now only
(W P)ᵀ r = Pᵀ (Wᵀ r) is asked for, and (9.31) is over the diagonal of JᵀJ where it is linearized.
"""

import math

import numpy as np

from factorbus.proto import inertial as of
from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_at, kept_samples
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.jit.simd import zero
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, form_of_imu, loss_code
from factorbus.solver.kernels.model.imu import BIAS_A, IMU_SCRATCH, ImuScratch, imu_of_delta, put_delta_near
from factorbus.solver.kernels.model.imu_layout import numbers_of_imu
from factorbus.solver.kernels.model.imu_noise import SIZE
from factorbus.solver.kernels.model.preintegration import ROOM
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of

_DIM = of.RESIDUAL
# Columns of the Jacobian: of a's bias; of b's, in which only the rows of its walk have anything; of mount and gravity.
_BIAS, _OF_BIAS_B, _FURTHER, _COLUMNS = 9, 24, 30, 40
# In an array for all of it: r, Wᵀ r, Δ, scratch, P; of each column δ, what the force misses, and the diagonal of JᵀJ.
_TURNS, _ROOM = 16, 32
_Y = _ROOM + ROOM
_P = _Y + IMU_SCRATCH
_MOVED = _P + _DIM * _COLUMNS
_TURNED, _DIAGONAL, _W = _MOVED + _COLUMNS, _MOVED + 2 * _COLUMNS, _MOVED + 3 * _COLUMNS


@part
def is_plain_imu(f: int, fac: I64, payload: F64) -> bool:
    """Whether the factor that begins at row f is of samples, without a loss, and its Ω is one."""
    if fac[f, at.F_KIND] != at.IMU or loss_code(f, fac) != at.NO_LOSS:
        return False
    p, off = fac[f, at.F_AT] + numbers_of_imu(form_of_imu(f, fac)), 0.0
    for n in range(_DIM * (_DIM + 1) // 2):
        off += abs(payload[p + n])
    for a in range(_DIM):
        off += abs(payload[p] - 1.0) - abs(payload[p])
        p += _DIM - a
    return off == 0.0


@inline_kernel
def fill_places(f: int, var: I64, fac: I64, places: I64) -> int:
    """Where the values of the variables begin; gives how many scalars they have."""
    columns = 0
    for n in range(places.size):
        v = end_of(f, n, fac)
        places[n], columns = var[v, at.V_AT], columns + dim_of(var[v, at.V_KIND])
    return columns


@inline_kernel
def whiten_residual(w: int, z: F64, r: F64) -> None:
    """The first nine of r times W, which begins at z[w]."""
    for i in range(SIZE - 1, -1, -1):
        row, total = w + i * (i + 1) // 2, 0.0
        for m in range(i + 1):
            total += z[row + m] * r[m]
        r[i] = total


@part
def evaluate_imu(f: int, graph: Graph, tree: Tree, w: F64) -> int:
    """The residual of factor f at the estimate to w[R], whitened, and its Jacobian, which is not, to w[P]; gives how
    many columns that has.
    """
    var, fac, x = graph.var, graph.fac, graph.values
    places, form, z = np.empty(count_ends(f, fac), np.int64), form_of_imu(f, fac), graph.payload[fac[f, at.F_AT] :]
    columns, scratch = fill_places(f, var, fac, places), ImuScratch(w[_ROOM : _ROOM + ROOM], w[_Y:_P])
    put_delta_near(form, z, kept_samples(f, var, fac, tree), x[places[BIAS_A] :], scratch.room)
    imu_of_delta(x, places, form, z, scratch, w, w[_P : _P + _DIM * columns].reshape(_DIM, columns))
    whiten_residual(form.start + of.SAMPLE * form.samples, z, w)
    return columns


@part
def residual_of_imu(f: int, graph: Graph, tree: Tree) -> F64:
    """The first `of.RESIDUAL` numbers are the residual at the estimate, whitened."""
    w = np.empty(_MOVED)
    evaluate_imu(f, graph, tree, w)
    return w


@part
def chi2_of_imu(f: int, graph: Graph, tree: Tree) -> float:
    """χ² at the estimate."""
    w = np.empty(_MOVED)
    evaluate_imu(f, graph, tree, w)
    return square_of_residual(w)


@inline_kernel
def square_of_residual(w: F64) -> float:
    """rᵀ r."""
    total = 0.0
    for a in range(_DIM):
        total += w[a] * w[a]
    return total


@part
def exact_error_of_imu(f: int, graph: Graph, tree: Tree) -> tuple[float, float, float]:
    """The error of the residual and of the force, and χ².

    The rows of the bias's walk are linear: of them is only what they add to the diagonal.
    """
    var, fac, linear, w = graph.var, graph.fac, tree.hessian, np.empty(_W)
    columns, k = evaluate_imu(f, graph, tree, w), jacobian_at(f, var, fac, tree.link)

    # 1. Wᵀ r, by which the slopes are multiplied that are not whitened; W is lower triangular.
    root = fac[f, at.F_AT] + numbers_of_imu(form_of_imu(f, fac)) - of.KEPT
    for m in range(SIZE):
        total = 0.0
        for i in range(m, SIZE):
            total += graph.payload[root + i * (i + 1) // 2 + m] * w[i]
        w[_TURNS + m] = total

    # 2. How far its variables are from where it is linearized.
    c = 0
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        d, size = var[v, at.V_SCALAR], dim_of(var[v, at.V_KIND])
        for e in range(size):
            w[_MOVED + c + e] = tree.scalars[0, d + e] if d >= 0 else 0.0
        c += size

    # 3. What the model misses of the residual, and of (W P)ᵀ r.
    zero(w, _TURNED, 2 * _COLUMNS)
    missed = 0.0
    for a in range(0, SIZE, 3):
        gaps = miss_rows(0, _OF_BIAS_B, k, a, columns, linear, w)
        if columns > _FURTHER:
            more = miss_rows(_FURTHER, columns, k, a, columns, linear, w)
            gaps = (gaps[0] + more[0], gaps[1] + more[1], gaps[2] + more[2])
        for m in range(3):
            gap = w[a + m] - linear[k + a + m] - gaps[m]
            missed += gap * gap
    for e in range(of.BIAS):
        slope = linear[k + _DIM + (SIZE + e) * columns + _BIAS + e]
        w[_DIAGONAL + _BIAS + e] += slope * slope

    # 4. The shares of all scalars that move.
    force, c = 0.0, 0
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        size = dim_of(var[v, at.V_KIND])
        for e in range(c, c + (size if var[v, at.V_SCALAR] >= 0 else 0)):
            if w[_DIAGONAL + e] > 0.0:
                force += w[_TURNED + e] * w[_TURNED + e] / w[_DIAGONAL + e]
        c += size
    return math.sqrt(missed), math.sqrt(force), square_of_residual(w)


@inline_kernel
def miss_rows(first: int, end: int, k: int, a: int, columns: int, linear: F64, w: F64) -> tuple[float, float, float]:
    """Of the columns from `first` to before `end` of the rows a, a + 1, a + 2: J δ, and what Pᵀ (Wᵀ r) − Jᵀ r and the
    squares of J add to their columns.
    """
    i, j = k + _DIM + a * columns, _P + a * columns
    r0, r1, r2 = w[a], w[a + 1], w[a + 2]
    t0, t1, t2 = w[_TURNS + a], w[_TURNS + a + 1], w[_TURNS + a + 2]
    g0 = g1 = g2 = 0.0
    for c in range(first, end):
        moved = w[_MOVED + c]
        s0, s1, s2 = linear[i + c], linear[i + columns + c], linear[i + 2 * columns + c]
        g0, g1, g2 = g0 + s0 * moved, g1 + s1 * moved, g2 + s2 * moved
        now = w[j + c] * t0 + w[j + columns + c] * t1 + w[j + 2 * columns + c] * t2
        w[_TURNED + c] += now - s0 * r0 - s1 * r1 - s2 * r2
        w[_DIAGONAL + c] += s0 * s0 + s1 * s1 + s2 * s2
    return g0, g1, g2
