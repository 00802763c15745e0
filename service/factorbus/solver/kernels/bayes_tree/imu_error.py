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
from factorbus.solver.kernels.jit.simd import at as load
from factorbus.solver.kernels.jit.simd import put
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, form_of_imu, loss_code
from factorbus.solver.kernels.model.imu import BIAS_A, imu_of_delta, put_delta_near
from factorbus.solver.kernels.model.imu_layout import ImuLayout, numbers_of_imu
from factorbus.solver.kernels.model.imu_noise import SIZE
from factorbus.solver.kernels.model.preintegration import ROOM
from factorbus.solver.kernels.model.records import Graph
from factorbus.solver.kernels.model.sizes import dim_of

_DIM = of.RESIDUAL


@part
def is_plain_imu(f: int, fac: I64, payload: F64) -> bool:
    """Whether the factor that begins at row f is of samples, without a loss, and its Ω is one."""
    if fac[f, at.F_KIND] != at.IMU or loss_code(f, fac) != at.NO_LOSS:
        return False
    p, off = fac[f, at.F_AT] + numbers_of_imu(form_of_imu(f, fac)), 0.0
    for n in range(_DIM * (_DIM + 1) // 2):
        off += abs(load(payload, p + n))
    for a in range(_DIM):
        off += abs(load(payload, p) - 1.0) - abs(load(payload, p))
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
def evaluate_imu(x: F64, places: I64, form: ImuLayout, z: F64, kept: F64, r: F64, P: F64) -> None:
    """r and its Jacobian at the estimate, neither whitened; kept: what the samples come to where it is linearized."""
    room = np.empty(ROOM)
    put_delta_near(form, z, kept, x[places[BIAS_A] :], room)
    imu_of_delta(x, places, form, z, room, r, P)


@part
def chi2_of_imu(f: int, graph: Graph, tree: Tree) -> float:
    """χ² at the estimate."""
    var, fac = graph.var, graph.fac
    places, form, z = np.empty(count_ends(f, fac), np.int64), form_of_imu(f, fac), graph.payload[fac[f, at.F_AT] :]
    columns = fill_places(f, var, fac, places)
    r, J = np.empty(_DIM), np.empty((_DIM, columns))
    evaluate_imu(graph.values, places, form, z, kept_samples(f, var, fac, tree), r, J)
    whiten_residual(form.start + of.SAMPLE * form.samples, z, r)
    total = 0.0
    for a in range(_DIM):
        total += r[a] * r[a]
    return total


@part
def exact_error_of_imu(f: int, graph: Graph, tree: Tree) -> tuple[float, float, float]:
    """The error of the residual and of the force, and χ²."""
    var, fac, linear = graph.var, graph.fac, tree.hessian
    places, form, z = np.empty(count_ends(f, fac), np.int64), form_of_imu(f, fac), graph.payload[fac[f, at.F_AT] :]
    columns = fill_places(f, var, fac, places)
    r, turns, P = np.empty(_DIM), np.empty(_DIM), np.empty(_DIM * columns)
    evaluate_imu(graph.values, places, form, z, kept_samples(f, var, fac, tree), r, P.reshape(_DIM, columns))

    # 1. r = W ρ, and Wᵀ r, by which the slopes are multiplied that are not whitened.
    w = form.start + of.SAMPLE * form.samples
    whiten_residual(w, z, r)
    for m in range(_DIM):
        turns[m] = 0.0 if m < SIZE else r[m]
    for i in range(SIZE):
        for m in range(i + 1):
            turns[m] += z[w + i * (i + 1) // 2 + m] * r[i]

    # 2. How far its variables are from where it is linearized.
    room = np.zeros(3 * columns)
    turned, diagonal, c = columns, 2 * columns, 0
    for n in range(places.size):
        v = end_of(f, n, fac)
        d, size = var[v, at.V_SCALAR], dim_of(var[v, at.V_KIND])
        for e in range(size if d >= 0 else 0):
            room[c + e] = tree.scalars[0, d + e]
        c += size

    # 3. What the model misses of the residual, and of (W P)ᵀ r.
    k, missed, chi2 = jacobian_at(f, var, fac, tree.link), 0.0, 0.0
    for a in range(_DIM):
        row, now, error, turn = k + _DIM + a * columns, a * columns, r[a], turns[a]
        gap = error - linear[k + a]
        for c in range(columns):
            slope = load(linear, row + c)
            gap -= slope * load(room, c)
            put(room, turned + c, load(room, turned + c) + load(P, now + c) * turn - slope * error)
            put(room, diagonal + c, load(room, diagonal + c) + slope * slope)
        missed, chi2 = missed + gap * gap, chi2 + error * error

    # 4. The shares of all scalars that move.
    force, c = 0.0, 0
    for n in range(places.size):
        v = end_of(f, n, fac)
        size = dim_of(var[v, at.V_KIND])
        for e in range(c, c + (size if var[v, at.V_SCALAR] >= 0 else 0)):
            if room[diagonal + e] > 0.0:
                force += room[turned + e] * room[turned + e] / room[diagonal + e]
        c += size
    return math.sqrt(max(missed, 0.0)), math.sqrt(force), chi2
