"""Sets of loop closures of which each two agree: see `factorbus.solver.closures.choosing`, which says what they mean.

Chances are compared and not computed with: what comes of them is summed where it is exact.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel

Flags: TypeAlias = NDArray[np.bool_]

MOST_BRANCHES = 20_000
# Of the numbers of a set: places of all, places of its members, the least odds of a place; then logarithms.
N_AMONG, N_PLACES, N_ALONE, N_BETWEEN = range(4)


@kernel("int64(boolean[:,::1], int64[::1], int64[::1])")
def list_largest(agree: Flags, among: I64, members: I64) -> int:
    """A largest set of which each agrees with each other one; gives how many these are.

    Branch and bound, for a few dozens.  Of several equal ones the same at every call.

    in   agree (n, n), symmetric  among: ascending
    out  members: of `among`, ascending
    """
    m = among.size
    order, degree = np.empty(m, np.int64), np.zeros(m, np.int64)
    for v in range(m):
        for u in range(m):
            degree[v] += agree[among[v], among[u]]
        place = v
        while place > 0 and degree[order[place - 1]] < degree[v]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = v
    # A branch: who is in, and who may come, which of these begins, and how many there are of both.
    taken, left, begin = np.empty((m + 2, m), np.int64), np.empty((m + 2, m), np.int64), np.zeros(m + 2, np.int64)
    in_it, may_come = np.zeros(m + 2, np.int64), np.zeros(m + 2, np.int64)
    best, largest, top = np.zeros(m, np.bool_), 0, 0
    for k in range(m):
        left[0, k] = order[k]
    may_come[0] = m
    for _ in range(MOST_BRANCHES):
        if top < 0:
            break
        if in_it[top] > largest:
            largest = in_it[top]
            for v in range(m):
                best[v] = False
            for k in range(largest):
                best[taken[top, k]] = True
        waiting = may_come[top] - begin[top]
        if waiting == 0 or in_it[top] + waiting <= largest:
            top -= 1
            continue
        first = left[top, begin[top]]
        begin[top] += 1
        for k in range(in_it[top]):
            taken[top + 1, k] = taken[top, k]
        taken[top + 1, in_it[top]] = first
        in_it[top + 1], begin[top + 1], count = in_it[top] + 1, 0, 0
        for k in range(begin[top], may_come[top]):
            u = left[top, k]
            if agree[among[first], among[u]]:
                left[top + 1, count] = u
                count += 1
        may_come[top + 1] = count
        top += 1
    count = 0
    for v in range(m):
        if best[v]:
            members[count] = among[v]
            count += 1
    return count


@kernel("void(int64[::1], UniTuple(float64[:,:,::1], 2), float64, int64[::1])")
def number_places(rows: I64, poses: tuple[F64, F64], within: float, places: I64) -> None:
    """The first of those before each in `rows`, or itself, that is between the same two places; it is no other's.

    in   poses: a and b of all closures, as matrices  within: metres
    out  places: one for each row, counted along `rows`
    """
    a, b = poses
    for k in range(rows.size):
        places[k] = k
        for p in range(k):
            if places[p] == p and is_near(a, rows[k], rows[p], within) and is_near(b, rows[k], rows[p], within):
                places[k] = p
                break


@inline_kernel
def is_near(T: F64, i: int, j: int, within: float) -> bool:
    """Whether the positions of two poses are no farther apart."""
    last, squares = T.shape[1] - 1, 0.0
    for r in range(last):
        difference = T[i, r, last] - T[j, r, last]
        squares += difference * difference
    return math.sqrt(squares) <= within


@inline_kernel
def put_chain(logarithm: F64, n: int, out: F64) -> None:
    """The logarithms along the tree that joins all of n by the least ones, n − 1 of them."""
    nearest, is_in = np.empty(n), np.zeros(n, np.bool_)
    for k in range(n):
        nearest[k] = logarithm[0, k]
    is_in[0] = True
    for m in range(n - 1):
        found = -1
        for k in range(n):
            if not is_in[k] and (found < 0 or nearest[k] < nearest[found]):
                found = k
        out[m] = nearest[found]
        is_in[found] = True
        for k in range(n):
            nearest[k] = min(nearest[k], logarithm[found, k])


@kernel("int64(boolean[:,::1], int64[::1], float64[:,:,::1], int64[::1], float64[::1])")
def list_rivals(agree: Flags, among: I64, logarithm: F64, members: I64, out: F64) -> int:
    """A largest set, of `list_largest`, and in `out` the logarithms along the tree of its least likely agreements."""
    count = list_largest(agree, among, members)
    if count > 1:
        put_chain(block_of_members(logarithm, 0, members, count), count, out)
    return count


@inline_kernel
def block_of_members(table: F64, layer: int, members: I64, count: int) -> F64:
    """What of a table (·, n, n) concerns the first members."""
    block = np.empty((count, count))
    for p in range(count):
        for q in range(count):
            block[p, q] = table[layer, members[p], members[q]]
    return block


@kernel(
    "int64(boolean[:,::1], int64[::1], UniTuple(float64[:,:,::1], 2), float64[::1], UniTuple(float64[:,:,::1], 2),"
    " UniTuple(float64, 3), int64[::1], float64[::1])"
)
def list_believed(
    agree: Flags,
    among: I64,
    chances: tuple[F64, F64],
    alone: F64,
    poses: tuple[F64, F64],
    limits: tuple[float, float, float],
    members: I64,
    out: F64,
) -> int:
    """A largest set of which each member is held by another one, and each place by the map or another place; gives how
    many these are, 0: there are not two.

    in   chances (2, n, n): of each two that agree, near and anywhere, and their logarithms  alone: of each, anywhere
         poses: a and b of each  limits: the odds of mistakes, the most that is believed, and how far a place is, metres
    out  members, ascending  out: as above; logarithms along the tree of the least likely agreements of places, then of
         members
    """
    chance, logarithm = chances
    odds, most, within = limits
    count = list_largest(agree, among, members)
    places = np.empty(among.size, np.int64)
    while count > 1:
        kept = 0
        for p in range(count):
            least = 1.0
            for q in range(count):
                least = min(least, chance[0, members[p], members[q]])
            if least <= most:
                places[kept] = members[p]  # for scratch
                kept += 1
        if kept < count:
            count = kept
            for p in range(count):
                members[p] = places[p]
            continue
        number_places(members[:count], poses, within, places)
        there, number = 0, np.empty(count, np.int64)
        for p in range(count):
            if places[p] == p:
                number[p] = there
                there += 1
            else:
                number[p] = number[places[p]]
        own, least_of = np.full(there, math.inf), np.full(there, math.inf)
        between, logarithms = np.full((there, there), math.inf), np.full((there, there), math.inf)
        for p in range(count):
            own[number[p]] = min(own[number[p]], odds * alone[members[p]])
            for q in range(count):
                one, other, both = number[p], number[q], chance[1, members[p], members[q]]
                if one != other and both < between[one, other]:
                    between[one, other], logarithms[one, other] = both, logarithm[1, members[p], members[q]]
                    least_of[one] = min(least_of[one], odds * both)
        kept = 0
        for p in range(count):
            if min(own[number[p]], least_of[number[p]]) <= most:
                members[kept] = members[p]
                kept += 1
        if kept < count:
            count = kept
            continue
        out[N_PLACES], out[N_ALONE] = there, math.inf
        for p in range(there):
            out[N_ALONE] = min(out[N_ALONE], own[p])
        put_chain(logarithms, there, out[N_BETWEEN:])
        put_chain(block_of_members(logarithm, 0, members, count), count, out[N_BETWEEN + there - 1 :])
        number_places(among, poses, within, places)
        out[N_AMONG] = 0
        for p in range(among.size):
            out[N_AMONG] += places[p] == p
        return count
    return 0


@kernel(
    "void(int64[::1], int64[::1], float64[::1], float64, UniTuple(float64[:,::1], 2), boolean[:,::1],"
    " UniTuple(float64[:,:,::1], 2))"
)
def put_pairs(
    i: I64, j: I64, distance: F64, gate: float, chances: tuple[F64, F64], agree: Flags, out: tuple[F64, F64]
) -> None:
    """What is known of pairs i, j, as tables of each two; of one with itself 1, and its logarithm.

    in   chances (m, 2): and their logarithms
    out  agree (n, n): whether d² is within the gate  out (2, n, n): both
    """
    n = len(agree)
    for k in range(n):
        agree[k, k] = False
        for layer in range(2):
            out[0][layer, k, k], out[1][layer, k, k] = 1.0, 0.0
    for k in range(i.size):
        p, q = i[k], j[k]
        agree[p, q] = agree[q, p] = distance[k] <= gate
        for layer in range(2):
            for which in range(2):
                out[which][layer, p, q] = out[which][layer, q, p] = chances[which][k, layer]
