"""What follows from what: values composed along factors, and variables determined by factors.  MATH §2.4, §5.4.

Both walk the new factors in their order; a factor that comes before what it could follow from waits on its ends.
Every factor is looked at no more than three times, in whatever order they come.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel, part, shared_kernel, types
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import place_idp
from factorbus.solver.kernels.model.composed import (
    FIRST,
    INNER,
    OUTER,
    SCRATCH,
    SECOND,
    put_inner,
    put_measurement,
    put_sensor,
)
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, form_of_imu, head_of, is_one_of_many
from factorbus.solver.kernels.model.imu import BIAS_B, POSE_B, place_by_imu
from factorbus.solver.kernels.model.kinds import SCALE, base_kind, end_of_modifier, initializes, is_joined
from factorbus.solver.kernels.model.records import Graph, graph_at
from factorbus.solver.kernels.model.se2 import (
    compose_inverse_se2,
    compose_se2,
    place_bearing_range_se2,
    place_landmark_se2,
)
from factorbus.solver.kernels.model.se3 import compose_inverse_se3, compose_se3, place_landmark_se3
from factorbus.solver.kernels.model.similarity import compose_similar, place_landmark_sim3
from factorbus.solver.kernels.model.sizes import MOST_ENDS, arity_of, information_at, size_of

_NOTHING = -1
_WAITS = -2


_COUNTS = types.int64[::1]


@shared_kernel(types.int64(types.boolean, types.int64, types.int64, types.int64, _COUNTS, _COUNTS))
def reach(compose: bool, v0: int, f0: int, f1: int, graph_table: I64, reached: I64) -> int:
    """Mark in `reached` (one entry per variable from v0 on, 1: reached) what factors f0 .. f1−1 lead to.

    Variables before v0 are reached.  With `compose` the first factor that reaches a variable gives it its value.
    Gives the first variable that is not reached, or −1.  graph_table: of the graph's arrays (`records`).
    """
    graph = graph_at(graph_table)
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    f = f0
    while f < f1 and follow(compose, f, v0, var, fac, values, payload, reached) != _WAITS:
        f += 1
    if f < f1:
        reach_on(compose, v0, f, f1, graph, reached)
    for v in range(reached.size):
        if reached[v] == 0:
            return v0 + v
    return -1


@part
def reach_on(compose: bool, v0: int, f0: int, f1: int, graph: Graph, reached: I64) -> None:
    """The same from the first factor that has to wait."""
    var, fac, values, payload = graph.var, graph.fac, graph.values, graph.payload
    n = reached.size
    head, tail = np.full(n, -1), np.full(n, -1)  # per variable: the factors that wait for it
    after = np.full(2 * (f1 - f0), -1)  # 2 (f − f0) + end: the next in that list
    queue = np.empty(n, np.int64)
    for f in range(f0, f1):
        new = follow(compose, f, v0, var, fac, values, payload, reached)
        if new == _WAITS:
            for end in range(2):
                v = fac[f, at.F_I + end] - v0
                if v >= 0:
                    slot = 2 * (f - f0) + end
                    if tail[v] < 0:
                        head[v] = slot
                    else:
                        after[tail[v]] = slot
                    tail[v] = slot
            continue
        if new < 0:
            continue
        queue[0], done, todo = new, 0, 1
        while done < todo:
            slot = head[queue[done] - v0]
            done += 1
            while slot >= 0:
                new = follow(compose, f0 + slot // 2, v0, var, fac, values, payload, reached)
                if new >= 0:
                    queue[todo] = new
                    todo += 1
                slot = after[slot]


@inline_kernel
def follow(compose: bool, f: int, v0: int, var: I64, fac: I64, x: F64, p: F64, reached: I64) -> int:
    """The variable that factor `f` reaches now, or _NOTHING, or _WAITS: both ends are still out of reach."""
    kind, i, j, z = fac[f, at.F_KIND], fac[f, at.F_I], fac[f, at.F_J], fac[f, at.F_AT]
    if is_one_of_many(f, fac):
        return follow_many(compose, head_of(f, fac), v0, var, fac, x, p, reached)
    if not initializes(kind):  # a pixel alone, say
        return _NOTHING
    has_i = i < v0 or reached[i - v0] != 0
    if j < 0:
        if has_i:
            return _NOTHING
        if compose:
            start = var[i, at.V_AT]
            for c in range(size_of(var[i, at.V_KIND])):
                x[start + c] = p[z + c]
        reached[i - v0] = 1
        return i
    has_j = j < v0 or reached[j - v0] != 0
    if has_i == has_j:
        return _NOTHING if has_i else _WAITS
    between = kind == at.BETWEEN_SE2 or kind == at.BETWEEN_SE3
    if not has_i and not between:  # a point does not place a pose
        return _WAITS
    new = j if has_i else i
    if compose:
        compose_end(kind, has_i, var[i, at.V_AT], var[j, at.V_AT], z, x, p)
    reached[new - v0] = 1
    return new


@part
def follow_many(compose: bool, f: int, v0: int, var: I64, fac: I64, x: F64, p: F64, reached: I64) -> int:
    """The same of the factor with a base that begins at row f, for any of its rows: each waits for its two variables.
    A mount, a scale or a clock's offset follows from nothing, and all else from it.
    """
    of, count, missing = base_kind(fac[f, at.F_KIND]), 0, -1
    if fac[f, at.F_KIND] == at.IMU or fac[f, at.F_KIND] == at.PREINTEGRATED:
        return follow_imu(compose, f, v0, var, fac, x, p, reached)
    if is_joined(fac[f, at.F_KIND]) and of < 0:
        return follow_similar(compose, f, v0, var, fac, x, p, reached)
    if of < 0 or not initializes(of):  # a linear factor
        return _NOTHING
    for n in range(count_ends(f, fac)):
        v = end_of(f, n, fac)
        if v >= v0 and reached[v - v0] == 0:
            count, missing = count + 1, n
    if count == 0:
        return _NOTHING
    between = of == at.BETWEEN_SE2 or of == at.BETWEEN_SE3
    if count > 1 or missing >= arity_of(of) or (missing == 0 and not between):
        return _WAITS
    new = end_of(f, missing, fac)
    if compose:
        compose_base(f, missing, between, var, fac, x, p)
    reached[new - v0] = 1
    return new


@part
def compose_base(f: int, missing: int, between: bool, var: I64, fac: I64, x: F64, p: F64) -> None:
    """Give the end of the base kind that has no value the one that makes the residual zero."""
    kind, new, known = fac[f, at.F_KIND], end_of(f, missing, fac), end_of(f, 1 - missing, fac)
    of, planar, forward = base_kind(kind), var[known, at.V_KIND] == at.SE2, missing == 1
    places, y, z = np.empty(MOST_ENDS, np.int64), np.zeros(SCRATCH), np.empty(information_at(kind) + 3)
    for n in range(count_ends(f, fac)):
        places[n] = var[end_of(f, n, fac), at.V_AT]
    put_measurement(kind, planar, x, places, p, fac[f, at.F_AT], z)
    has_inner, scale = put_inner(kind, planar, x, places, z, y), end_of_modifier(kind, SCALE)
    if scale >= 0:
        for c in range(2 if planar else 3):
            z[c] *= x[places[scale]]
    put_sensor(has_inner, planar, x, var[known, at.V_AT], y, FIRST)
    compose_end(of, forward, FIRST if forward else SECOND, SECOND if forward else FIRST, 0, y, z)
    out = SECOND if forward else FIRST
    if between and has_inner:
        if planar:
            compose_inverse_se2(y, out, y, INNER, OUTER)
        else:
            compose_inverse_se3(y, out, y, INNER, OUTER)
        out = OUTER
    for c in range(size_of(var[new, at.V_KIND])):
        x[var[new, at.V_AT] + c] = y[out + c]


@part
def follow_imu(compose: bool, f: int, v0: int, var: I64, fac: I64, x: F64, p: F64, reached: I64) -> int:
    """The same of an inertial factor: pose, velocity and bias at its end follow from those at its beginning, its
    mount and gravity, one with each of its rows, and nothing the other way."""
    missing, waits = -1, False
    for n in range(count_ends(f, fac) - 1, -1, -1):
        v = end_of(f, n, fac)
        if v >= v0 and reached[v - v0] == 0:
            missing = n
            waits |= n < POSE_B or n > BIAS_B
    if missing < 0:
        return _NOTHING
    if waits:
        return _WAITS
    new = end_of(f, missing, fac)
    if compose:
        places = np.empty(count_ends(f, fac), np.int64)
        for n in range(places.size):
            places[n] = var[end_of(f, n, fac), at.V_AT]
        place_by_imu(missing, x, places, form_of_imu(f, fac), p[fac[f, at.F_AT] :])
    reached[new - v0] = 1
    return new


@part
def follow_similar(compose: bool, f: int, v0: int, var: I64, fac: I64, x: F64, p: F64, reached: I64) -> int:
    """The same of a factor of rotations or similarities, of one variable or two."""
    kind, i, j, z = fac[f, at.F_KIND], fac[f, at.F_I], fac[f, at.F_J], fac[f, at.F_AT]
    if not initializes(kind):
        return _NOTHING
    has_i, has_j = i < v0 or reached[i - v0] != 0, j < v0 or reached[j - v0] != 0
    if has_i and has_j:
        return _NOTHING
    new = i if not has_i else j
    if j >= 0 and not has_i and (not has_j or kind == at.LANDMARK_SIM3):
        return _WAITS
    if compose and j < 0:
        for c in range(size_of(var[i, at.V_KIND])):
            x[var[i, at.V_AT] + c] = p[z + c]
    elif compose and kind == at.LANDMARK_SIM3:
        place_landmark_sim3(x, var[i, at.V_AT], p, z, var[j, at.V_AT])
    elif compose:
        compose_similar(kind, has_i, var[i, at.V_AT], var[j, at.V_AT], z, x, p)
    reached[new - v0] = 1
    return new


@part
def compose_end(kind: int, forward: bool, i: int, j: int, z: int, x: F64, p: F64) -> None:
    """Give the end that has no value the one that makes the residual zero."""
    if kind == at.BETWEEN_SE2:
        if forward:
            compose_se2(x, i, p, z, j)
        else:
            compose_inverse_se2(x, j, p, z, i)
    elif kind == at.BETWEEN_SE3:
        if forward:
            compose_se3(x, i, p, z, j)
        else:
            compose_inverse_se3(x, j, p, z, i)
    elif kind == at.LANDMARK_SE2:
        place_landmark_se2(x, i, p, z, j)
    elif kind == at.LANDMARK_SE3:
        place_landmark_se3(x, i, p, z, j)
    elif kind == at.BEARING_RANGE_SE2:
        place_bearing_range_se2(x, i, p, z, j)
    elif kind == at.IDP_FIRST:
        place_idp(x, i, p, z, j)


@kernel("int64(int64, int64, int64, int64, int64[:,::1], int64[::1], int64[::1])")
def join(v0: int, v1: int, f0: int, f1: int, fac: I64, anchored: I64, root: I64) -> int:
    """The first new variable (v0 .. v1−1) that no chain of new factors joins to an anchored one, or −1.

    anchored (v1 − v0,): 1 where a prior or being fixed holds it; all variables before v0 are.  root: scratch, one more
    entry than that; entry 0 stands for all that is anchored.
    """
    for k in range(v1 - v0 + 1):
        root[k] = k
    for v in range(v0, v1):
        if anchored[v - v0] != 0:
            root[v - v0 + 1] = 0
    for f in range(f0, f1):
        if fac[f, at.F_J] >= 0:
            a = find_root(max(fac[f, at.F_I] - v0 + 1, 0), root)
            b = find_root(max(fac[f, at.F_J] - v0 + 1, 0), root)
            root[max(a, b)] = min(a, b)
    for v in range(v0, v1):
        if find_root(v - v0 + 1, root) != 0:
            return v
    return -1


@inline_kernel
def find_root(k: int, root: I64) -> int:
    """The representative of k's set, halving the path to it."""
    while root[k] != k:
        root[k] = root[root[k]]
        k = root[k]
    return k
