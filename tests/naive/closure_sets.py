"""Sets of loop closures that agree, as they are defined: what `kernels/closures/sets` finds in one pass, by NumPy."""

import itertools

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64


def every_largest(agree: np.ndarray) -> list[tuple[int, ...]]:
    """All sets of the largest size of which each two agree."""
    n = len(agree)
    for size in range(n, 0, -1):
        chosen = itertools.combinations(range(n), size)
        found = [some for some in chosen if all(agree[p, q] for p, q in itertools.combinations(some, 2))]
        if found:
            return found
    return [()]


def places_of(a: F64, b: F64, within_m: float) -> I64:
    """(n,): the first of those before each, or itself, that is between the same two places; it is no other's."""
    near = [np.linalg.norm(T[:, None, :-1, -1] - T[None, :, :-1, -1], axis=-1) <= within_m for T in (a, b)]
    same, number = near[0] & near[1], np.arange(len(a))
    for k in range(len(number)):
        number[k] = np.flatnonzero(same[k, : k + 1] & (number[: k + 1] == np.arange(k + 1)))[0]
    return number


def chain_of(chance: F64) -> float:
    """Σ ln p over the tree that joins all of n by the least likely agreements; chance (n, n)."""
    is_in, total = {0}, 0.0
    while len(is_in) < len(chance):
        least, k = min((chance[p, q], q) for p in is_in for q in range(len(chance)) if q not in is_in)
        total += float(np.log(least))
        is_in.add(k)
    return total


def held_members(
    members: I64, chance: F64, alone: F64, places: tuple[F64, F64, float], most: float, odds: float
) -> tuple[I64, I64, float, F64]:
    """Of a set, the members that others hold, and whose places the map or other places hold; their places, the least
    odds of one, and the odds between each two.

    chance (n, n, 2): near and anywhere.  places: a and b of all, and how far a place is.
    """
    a, b, within_m = places
    while members.size > 1:
        sure = chance[np.ix_(members, members)][..., 0].min(axis=1) <= most
        if not sure.all():
            members = members[sure]
            continue
        anywhere, own = chance[np.ix_(members, members)][..., 1], places_of(a[members], b[members], within_m)
        there, place = np.unique(own, return_inverse=True)
        least = np.array([odds * alone[members[own == p]].min() for p in there])
        between = np.array([[anywhere[own == p][:, own == q].min() for q in there] for p in there])
        np.fill_diagonal(between, np.inf)
        held = np.minimum(least, odds * between.min(axis=1)) <= most
        if held.all():
            return members, own, float(least.min()), between
        members = members[held[place]]
    return members[:0], members[:0], 1.0, np.empty((0, 0))
