"""Which parts of a map no factor joins, and what holds each: found from a copy of the map when somebody asks."""

from collections.abc import Mapping, Sequence

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.components import COMPONENTS_LISTED, Component, Components
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS, name_of_kind
from factorbus.proto.linear_in_frame import said_of_frame
from factorbus.proto.messages import Batch, Factors, MapGraph
from factorbus.proto.roles import AXES, FRAME, MOUNT, keys_in_no_frame, keys_of_role
from factorbus.proto.symbols import symbol_parts

_NONE = np.empty(0, np.int64)
_PRIORS = ("prior_se2", "prior_se3")
_LETTER_BITS = 56


def components_of_map(graph: MapGraph) -> Components:
    """The components of a map, the largest first.

    What is the same in every frame joins nothing: two robots with one camera's mount are in no common frame for that.
    """
    # 1. The variables that are in a frame, and the component of each.
    batch = graph.batch
    aside = keys_in_no_frame(batch)
    named = np.concatenate([_NONE, *(group.keys for group in batch.variables)])
    keys = np.setdiff1d(named, aside)
    rows = [_rows(group, keys) for group in batch.factors]
    count, component = _labels(keys.size, rows)
    # 2. What each has, and what holds it.
    first = np.unique(component, return_index=True)[1]  # keys ascend
    variables = np.bincount(component, minlength=count)
    factors, held, gauges = _held(batch, keys, rows, component, count)
    # 3. The largest first, of equal ones that with the least key.
    order = np.lexsort((keys[first], -variables))[:COMPONENTS_LISTED].tolist()
    letters = _letters(keys, component, count)
    listed = [
        Component(int(keys[first[n]]), int(variables[n]), int(factors[n]), letters[n], held[n], gauges[n])
        for n in order
    ]
    return Components(graph.epoch, graph.revision, count, tuple(listed), named.size - keys.size)


def _rows(group: Factors, keys: I64) -> I64:
    """(m, k): where the variables of each factor are among `keys`; −1: in no frame."""
    if not keys.size:
        return np.full(group.keys.shape, -1)
    found = np.minimum(np.searchsorted(keys, group.keys), keys.size - 1)
    return np.where(keys[found] == group.keys, found, -1)


def _labels(size: int, rows: Sequence[I64]) -> tuple[int, I64]:
    """(how many components there are, that of each variable)."""
    if not size:
        return 0, _NONE
    # Who does not ask does without: it takes a tenth of a second.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    one, other = [_NONE], [_NONE]
    for ends in rows:
        anchor = ends.max(axis=1, initial=-1)
        for end in ends.T:
            joined = end >= 0
            one.append(anchor[joined])
            other.append(end[joined])
    pairs = np.concatenate(one), np.concatenate(other)
    found = connected_components(coo_array((np.ones(pairs[0].size, bool), pairs), shape=(size, size)), directed=False)
    return int(found[0]), found[1].astype(np.int64)


def _held(
    batch: Batch, keys: I64, rows: Sequence[I64], component: I64, count: int
) -> tuple[I64, list[dict[str, int]], list[bool]]:
    """Of each component: its factors, what says where it is in the map's frame, whether that is one gauge alone."""
    factors, held = np.zeros(count, np.int64), [dict[str, int]() for _ in range(count)]
    poses = np.zeros(count, np.int64)
    for group in batch.variables:
        if group.fixed:
            chosen = component[np.searchsorted(keys, group.keys[np.isin(group.keys, keys)])]
            _count("fixed", chosen, held)
            if VARIABLE_KINDS[group.kind].is_pose:
                poses += np.bincount(chosen, minlength=count)
    roles = {role: keys_of_role(batch, role) for role in (MOUNT, FRAME, AXES)}
    for group, ends in zip(batch.factors, rows, strict=True):
        anchor = ends.max(axis=1, initial=-1)
        factors += np.bincount(component[anchor[anchor >= 0]], minlength=count)
        _count(name_of_kind(group.kind), component[anchor[(anchor >= 0) & _say_where(group, roles)]], held)
        if group.kind in _PRIORS:
            poses += np.bincount(component[anchor[anchor >= 0]], minlength=count)
    return factors, held, [sum(each.values()) == 1 and bool(poses[n] == 1) for n, each in enumerate(held)]


def _say_where(group: Factors, roles: Mapping[str, I64]) -> np.ndarray:
    """(m,): which factors say where their variables are in the map's frame.

    What a linear factor says is in its numbers.  Which way is up is no place: a part that only knows that, as of an
    IMU, is in a frame of its own.
    """
    kind = FACTOR_KINDS[group.kind]
    if not kind.is_linear:
        return np.full(len(group.keys), kind.is_absolute)
    ends = []
    for end in group.keys.T:
        names = np.full(len(end), "", "U8")
        for role, of_role in roles.items():
            names[np.isin(end, of_role)] = role
        ends.append(names.tolist())
    return said_of_frame(group, ends).place


def _count(name: str, chosen: I64, held: list[dict[str, int]]) -> None:
    """So many of the kind are in each component."""
    for n, times in zip(*(each.tolist() for each in np.unique(chosen, return_counts=True)), strict=True):
        held[n][name] = held[n].get(name, 0) + times


def _letters(keys: I64, component: I64, count: int) -> list[dict[str, int]]:
    """How many variables of each component have each letter."""
    found = [dict[str, int]() for _ in range(count)]
    pairs, times = np.unique(component << 8 | keys >> _LETTER_BITS & 255, return_counts=True)
    for pair, many in zip(pairs.tolist(), times.tolist(), strict=True):
        n, code = pair >> 8, pair & 255
        letter = symbol_parts(code << _LETTER_BITS)[0] if code < 128 else ""  # above: keys below 0
        found[n][letter] = found[n].get(letter, 0) + many
    return found
