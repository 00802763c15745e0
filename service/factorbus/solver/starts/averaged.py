"""The start by rotation averaging: values of all variables that follow from the factors alone.  MATH §12."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import variables_aside
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.carried import carry, tied
from factorbus.solver.starts.components import components_of, docked
from factorbus.solver.starts.losses import narrowing, weights_of
from factorbus.solver.starts.normal import summed
from factorbus.solver.starts.relations import (
    MAP,
    PLANE,
    SPACE,
    Directions,
    PoseSpace,
    Relations,
    poses_apart,
    relations_of,
)
from factorbus.solver.starts.rotation_matrices import nearest_rotations, quaternions_of
from factorbus.solver.starts.rotations import averaged_rotations
from factorbus.solver.starts.together import rotations_with_places
from factorbus.solver.starts.translations import distances, solve_positions

# More components than these that nothing holds are not brought to each other: each takes a while.
_MOST = 100


@dataclass(frozen=True, slots=True)
class Nodes:
    """The map and all variables as they are, in one space.

    R (N, d, d), t (N, d); of what is no node of this space the identity and the origin.
    pose, point, fixed (N,): what each is; the map is a fixed pose.
    rank (N,): the order in which they are eliminated, of what is free; None: any.
    """

    R: F64
    t: F64
    pose: np.ndarray
    point: np.ndarray
    fixed: np.ndarray
    rank: I64 | None


def averaged(graph: FactorGraph, order: I64 | None = None) -> list[F64]:
    """Values for a graph, laid out as its own, from averaged rotations: none if it has no poses, nothing holds them, or
    its factors are of sorts, such as pixels, that say nothing of rotations or places by themselves.

    Two if it has points whose places are measured: rotations by themselves, and together with places.  The values that
    the graph has count only where the factors leave something open, as how far along a ray a point is.
    order: the block columns of Λ as R eliminates them, where that is known: good for all of its parts, too.
    """
    kinds = graph.var[: graph.counts[at.VARIABLES], at.V_KIND]
    spaces = [_Averaging(graph, space, order) for space in (PLANE, SPACE) if (kinds == space.pose).any()]
    spaces = [each for each in spaces if each.says_something]
    found = []
    for together in (False, True) if any(each.has_places for each in spaces) else (False,):
        values = graph.values.copy()
        written = [each.write(values, together and each.has_places) for each in spaces]
        if written and all(written):
            found.append(values)
    return found


class _Averaging:
    """One space of a graph: what its factors say, and what it is before anything is averaged."""

    def __init__(self, graph: FactorGraph, space: PoseSpace, order: I64 | None) -> None:
        self._graph, self._space, self._nodes = graph, space, _nodes(graph, space, order)
        relations, self._directions = relations_of(graph, space)
        self.says_something = bool(len(relations) or len(self._directions.b))
        self.has_places = bool((self._nodes.point[relations.b] & (relations.a != MAP)).any())
        self._relations = tied(graph, space, relations, self._nodes.R, self._nodes.t)

    def write(self, values: F64, together: bool) -> bool:
        """Write the poses and points into `values`; False: nothing holds some rotation."""
        nodes, relations = self._nodes, self._relations
        found = self._solve(relations, together)
        if found is not None and (relations.loss != at.NO_LOSS).any():
            s = distances(relations, *found)
            for wide in narrowing(relations.loss, s, relations.scale):
                weights = weights_of(relations.loss, s, wide * relations.scale)
                found = self._solve(relations.weighed(weights), together)
                if found is None:
                    return False
                s = distances(relations, *found)
        if found is None:
            return False
        R, t = found
        _write(self._graph, self._space, nodes, R, t, values)
        carry(self._graph, self._space, (nodes.R, nodes.t), (R, t), values)
        return True

    def _solve(self, relations: Relations, together: bool) -> tuple[F64, F64] | None:
        """Rotations and places of all nodes; None: nothing holds some rotation."""
        nodes, directions = self._nodes, self._directions
        label = components_of(relations.where(relations.turn > 0.0), nodes.fixed)
        label = np.where(nodes.pose, label, MAP)
        # 1. Rotations, those of each component that nothing holds from its first pose on.
        known = nodes.fixed | ~nodes.pose
        known[_firsts(label)] = True
        held = directions.where(label[directions.b] == MAP)
        if together and not label.any():
            R = rotations_with_places(relations, held, nodes.fixed, nodes.pose, nodes.R, nodes.t, nodes.rank)
        else:
            R = averaged_rotations(relations, held, known, nodes.R, nodes.rank)
        if R is None:
            return None
        # 2. Such components to where they lie in the map.
        R = _bring_together(relations, directions, nodes, R, label)
        # 3. Places.
        return R, _place(relations, nodes, R, np.ones(label.size, bool))


def _nodes(graph: FactorGraph, space: PoseSpace, order: I64 | None) -> Nodes:
    count, d = int(graph.counts[at.VARIABLES]), space.dim
    var, size = graph.var[:count], 3 if d == 2 else 7
    R, t = np.tile(np.eye(d), (count + 1, 1, 1)), np.zeros((count + 1, d))
    pose, point, fixed = (np.zeros(count + 1, bool) for _ in range(3))
    pose[1:], point[1:], fixed[1:] = (
        var[:, at.V_KIND] == space.pose,
        var[:, at.V_KIND] == space.point,
        var[:, at.V_COLUMN] < 0,
    )
    R[pose], t[pose] = poses_apart(graph.values[var[pose[1:], at.V_AT, None] + np.arange(size)])
    t[point] = graph.values[var[point[1:], at.V_AT, None] + np.arange(d)]
    fixed[1 + variables_aside(graph.fac[: graph.counts[at.FACTORS]])] = True  # not in the map: as they are
    pose[0] = fixed[0] = True
    return Nodes(R, t, pose, point, fixed, None if order is None else _ranks(var[:, at.V_COLUMN], order))


def _ranks(columns: I64, order: I64) -> I64:
    """(N,): of each node the place of its block column in `order`; of what has none, −1."""
    rank, place = np.full(1 + columns.size, -1), np.empty(order.size, np.int64)
    place[order] = np.arange(order.size)
    rank[1:][columns >= 0] = place[columns[columns >= 0]]
    return rank


def _firsts(label: I64) -> I64:
    """The first node of each label but 0."""
    loose, first = np.unique(label, return_index=True)
    return first[loose != 0]


def _bring_together(relations: Relations, directions: Directions, nodes: Nodes, R: F64, label: I64) -> F64:
    """Turn components that nothing holds by what they have in common with the map, until none is left that has."""
    loose = np.unique(label[label != 0]).tolist()
    R, inside = R.copy(), label == 0
    while loose:
        t = _place(relations, nodes, R, inside) if len(loose) <= _MOST else nodes.t
        left = []
        for each in loose:
            members = label == each
            Q = docked(members, relations, directions, R, t, inside, nodes.R) if len(loose) <= _MOST else None
            if Q is None:
                left.append(each)
            else:
                R[members] = Q @ R[members]
                inside |= members
        if len(left) == len(loose):
            break
        loose = left
    if loose:  # as they lie now
        of = np.isin(label, loose)
        _, which = np.unique(label[of], return_inverse=True)
        turns = summed(which, nodes.R[of] @ R[of].transpose(0, 2, 1), len(loose))
        R[of] = nearest_rotations(turns)[which] @ R[of]
    return R


def _place(relations: Relations, nodes: Nodes, R: F64, inside: np.ndarray) -> F64:
    """Places of all nodes that what is inside leads to; others, and one of what nothing holds, stay where they are."""
    inside = inside | nodes.point
    used = relations.where(inside[relations.a] & inside[relations.b])
    label = components_of(used, nodes.fixed)
    known = nodes.fixed | ~inside
    known[_firsts(label)] = True
    return solve_positions(used, R, nodes.t, known, nodes.rank)


def _write(graph: FactorGraph, space: PoseSpace, nodes: Nodes, R: F64, t: F64, values: F64) -> None:
    """The free poses and points as variables have them."""
    d, start = space.dim, graph.var[: graph.counts[at.VARIABLES], at.V_AT]
    for of in (nodes.pose & ~nodes.fixed, nodes.point & ~nodes.fixed):
        values[start[of[1:], None] + np.arange(d)] = t[of]
    of = nodes.pose & ~nodes.fixed
    if d == 2:
        values[start[of[1:]] + 2] = np.arctan2(R[of, 1, 0], R[of, 0, 0])
    else:
        values[start[of[1:], None] + 3 + np.arange(4)] = quaternions_of(R[of])
