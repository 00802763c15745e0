"""Which factors are false?  Graduated non-convexity over all that close loops.  MATH §11.2.

After Yang, Antonante, Tzoumas and Carlone, "Graduated Non-Convexity for Robust Spatial Perception" (2020), with the
truncated least squares cost min(s, c²), s = rᵀ Ω r: a factor that is off by more than c standard deviations counts c²,
however far off it is.

    1  suspects are the factors whose ends others join already; the rest, a spanning forest, is trusted
    2  begin with μ small: a convex problem, in which all suspects pull a little
    3  weigh every suspect by how far off it is, solve, enlarge μ; until each weighs 1 or 0
    4  twice: from the present estimate, and from what the trusted factors alone say; the better end counts
"""

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass

import numpy as np

from factorbus.proto.inertial import MOMENTS
from factorbus.solver import errors
from factorbus.solver.changes.edited import edited
from factorbus.solver.changes.requested import unchanged
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, rows_of_factors
from factorbus.solver.graph.groups import Group
from factorbus.solver.inc_l.incremental import Incremental
from factorbus.solver.kernels.graph.initialize import reach
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.kinds import JOINS_PLACES, OF_FAMILY
from factorbus.solver.optimize.gauss_newton import StoppingRule, minimize
from factorbus.solver.optimize.system import System
from factorbus.solver.options import Options
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.elimination import Elimination
from factorbus.wording import outside

_GROWTH, _ROUNDS = 1.4, 100
# A weight of nothing keeps the pattern of Λ, and its pivots: a hundred millionth of a factor holds nothing.
_LEAST = 1e-8
_BINARY = 1e-2
_SURE = (1e-12, 1.0 - 1e-12)  # where quantiles of χ² are numbers that can be computed with
_NONE = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class Repair:
    """What a map would be without its false factors.

    false (n,): their ids   distance (n,): s of each at the repaired estimate   suspects: how many were looked at
    before, after: Σ min(s, c²) over the suspects and χ² of the others, as the map is and repaired
    chi2_left: χ² of all factors but the false ones, repaired   rounds: solved for   groups: the repaired estimate
    """

    false: I64
    distance: F64
    suspects: int
    before: float
    after: float
    chi2_left: float
    rounds: int
    groups: list[Group]


def repair(graph: FactorGraph, factors: I64 | None = None, probability: float = 0.99) -> Repair:
    """Find what is false among `factors` (ids); None: among all that close loops.  `graph` stays as it is.

    probability: with which a right measurement is within c².  Raises UnknownFactor, BadOption.
    """
    if not _SURE[0] <= probability <= _SURE[1]:
        raise errors.BadOption("probability", outside(probability, *_SURE), f"from {_SURE[0]:g} to 1 - {_SURE[0]:g}")
    rows = find_loops(graph) if factors is None else _rows(graph, factors)
    problem = _Problem(graph, rows, probability)
    before = problem.cost(graph.values)
    best, after, rounds = graph.values, before, 0
    for begin in _beginnings(graph, rows) if rows.size else ():
        values, used = _graduate(problem, begin)
        rounds += used
        if (reached := problem.cost(values)) < after:
            best, after = values, reached
    distance = problem.distances(best)
    false = distance > problem.bound
    repaired = graph.copied()
    repaired.values = best
    ids = graph.ids_of(rows[false])
    left = after - float(problem.bound[false].sum())
    return Repair(ids, distance[false], rows.size, before, after, left, rounds, repaired.variables())


def find_loops(graph: FactorGraph) -> I64:
    """Rows of the factors between variables that factors before them, or being fixed, join already.

    Linear factors of more than two variables, which marginals are, inertial ones, and own kinds of more, join, and are
    no suspects.
    """
    count = int(graph.counts[at.VARIABLES])
    above = list(range(count + 1))
    for v in np.flatnonzero(graph.var[:count, at.V_COLUMN] < 0).tolist():
        above[v] = count  # the ground
    loops = []
    fac = graph.fac[: graph.counts[at.FACTORS]]
    for f in np.flatnonzero(is_first(fac)).tolist():  # its first row is without a mount, a bias, and the like
        i, j = fac[f, at.F_I : at.F_J + 1].tolist()
        if j < 0 or not JOINS_PLACES[fac[f, at.F_KIND]]:
            continue
        if OF_FAMILY[fac[f, at.F_KIND]] and len(ends := graph.ends_of(f)) > 2:
            is_inertial = fac[f, at.F_KIND] in (at.IMU, at.PREINTEGRATED)
            for v in ends[1 : MOMENTS if is_inertial else None]:  # robots may share gravity, as they do no place
                _join(above, ends[0], v)
        elif not _join(above, i, j):
            loops.append(f)
    return np.array(loops, np.int64)


def _join(above: list[int], i: int, j: int) -> bool:
    """Join two variables; False: they are."""
    first, second = _root(above, i), _root(above, j)
    above[min(first, second)] = max(first, second)
    return first != second


def _root(above: list[int], v: int) -> int:
    while above[v] != v:
        above[v] = above[above[v]]
        v = above[v]
    return v


def _rows(graph: FactorGraph, ids: I64) -> I64:
    ids = np.unique(ids)
    rows = graph.rows_of(ids)
    if (missing := np.flatnonzero(rows < 0)).size:
        raise errors.UnknownFactor(int(ids[missing[0]]), graph.next_id)
    return rows


def _beginnings(graph: FactorGraph, rows: I64) -> Iterable[F64]:
    """The present values, and those that the trusted factors compose if they reach everything."""
    yield graph.values
    trusted = np.ones(int(graph.counts[at.FACTORS]), bool)
    trusted[rows_of_factors(graph.fac, rows)] = False
    composed = copy(graph)
    composed.fac, composed.values = graph.fac[: trusted.size][trusted], graph.values.copy()
    reached = (graph.var[: graph.counts[at.VARIABLES], at.V_COLUMN] < 0).astype(np.int64)
    if reach(True, 0, 0, len(composed.fac), composed.array_table, reached) < 0:
        yield composed.values


class _Problem:
    """The graph with its suspects weighed, none of them with a loss of its own."""

    def __init__(self, graph: FactorGraph, rows: I64, probability: float) -> None:
        edits = unchanged(graph)
        edits.loss[rows] = at.NO_LOSS
        self.graph, self.rows = edited(graph, edits), rows
        self._as_given = self.graph.payload.copy()
        dims = np.array([self.graph.kind_of(row).dim for row in rows.tolist()], np.int64)
        self.bound = threshold(dims, probability)
        measured, sizes = self.graph.sizes_of(rows)
        starts = self.graph.fac[rows, at.F_AT] + measured
        along = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        self._places, self._sizes = np.repeat(starts, sizes) + along, sizes
        options = Options(mode="all-batch")
        self._system = System(self.graph, Incremental(Elimination(options), options))
        self._system.blocks.extend(self.graph, (0,) * at.COUNTS)

    def distances(self, values: F64) -> F64:
        """s of every suspect."""
        g = self.graph
        return np.array([sum_chi2(f, f + 1, g.var, g.fac, values, self._as_given) for f in self.rows.tolist()])

    def cost(self, values: F64) -> float:
        """χ² of the trusted factors, and of every suspect s or c²."""
        g, s = self.graph, self.distances(values)
        whole = float(sum_chi2(0, int(g.counts[at.FACTORS]), g.var, g.fac, values, self._as_given))
        return whole - float(s.sum()) + float(np.minimum(s, self.bound).sum())

    def begin(self, values: F64) -> None:
        """The next solution begins here."""
        self.graph.values = values.copy()

    def solve(self, weights: F64, tolerance: float, limit: int) -> None:
        """From where it is to the optimum with these weights, or close to it."""
        g = self.graph
        g.payload[self._places] = self._as_given[self._places] * np.repeat(weights, self._sizes)
        self._system.begin(_NONE, Stopwatch(None))
        self._system.anew()
        chi2 = float(sum_chi2(0, int(g.counts[at.FACTORS]), g.var, g.fac, g.values, g.payload))
        minimize(self._system, chi2, 0.0, StoppingRule(tolerance, 1e-12, limit))


def _graduate(problem: _Problem, begin: F64) -> tuple[F64, int]:
    """From `begin` to where every suspect weighs all or nothing; gives the values there, and the rounds it took."""
    problem.begin(begin)
    s = problem.distances(begin)
    worst = float((s / problem.bound).max())
    if not worst > 0.5:
        return begin, 0
    mu, rounds = 1.0 / (2.0 * worst - 1.0), 0
    while rounds < _ROUNDS:
        weights = weigh(s, problem.bound, mu)
        problem.solve(weights, 1e-4, 6)
        s, rounds, mu = problem.distances(problem.graph.values), rounds + 1, _GROWTH * mu
        if mu > 1.0 and (np.minimum(weights, 1.0 - weights) < _BINARY).all():
            break
    problem.solve(np.where(s > problem.bound, _LEAST, 1.0), 1e-10, 50)
    return problem.graph.values, rounds + 1


def weigh(s: F64, bound: F64, mu: float) -> F64:
    """The weight of a factor that is off by s, with c² = bound.  (11.3)"""
    low, high = mu / (mu + 1.0) * bound, (mu + 1.0) / mu * bound
    middle = np.sqrt(bound * mu * (mu + 1.0) / np.clip(s, low, high)) - mu
    weights = np.where(s >= high, 0.0, np.where(s <= low, 1.0, middle))
    return np.clip(weights, _LEAST, 1.0)
