"""The tree of cliques: per-step work in proportion to what a step changes.  MATH §9.

This is the memory of `kernels/bayes_tree/step.py`, which does the work in one call; here is what grows.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from factorbus.solver.graph import pages
from factorbus.solver.graph.arenas import Arenas, lines, roomy, with_room
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree import records
from factorbus.solver.kernels.bayes_tree.add_to_tree import SAVED
from factorbus.solver.kernels.bayes_tree.changed_variables import exchange, list_changed
from factorbus.solver.kernels.bayes_tree.hessian_room import MOST_ROOM
from factorbus.solver.kernels.bayes_tree.remaining import remaining_decrement
from factorbus.solver.kernels.bayes_tree.reset_estimate import reset_to_linearization
from factorbus.solver.kernels.bayes_tree.step import tree_step
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.jit.scratch import WORDS
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.task_queue import NOBODY
from factorbus.solver.options import Options
from factorbus.solver.sparse.worker_threads import TASK_QUEUE

_FEW = 8  # new variables for which good first values are looked for
PLANNED = 0.9  # of a budget: what the parts of a step take is known beforehand to a tenth or so


class CliqueTree(Arenas):
    """R, d, δ and linearization points of a graph, kept by cliques.  The arrays are public: tests look at them."""

    ARENAS = records.Tree._fields
    NOT_KEPT = ("_graph", "_rest", "settings", "marked", "scratch", "array_table")

    def __init__(self, graph: FactorGraph, options: Options) -> None:
        self._graph, self._rest = graph, options.tuning.relinearize_cooldown_steps
        self.settings: F64 = settings_of(options)
        self.clear()

    @contextmanager
    def placing_none(self) -> Iterator[None]:
        """While inside, variables that are new to the tree stay at the values that they have."""
        place, self.settings[tl.P_INITIALIZE] = self.settings[tl.P_INITIALIZE], -1
        try:
            yield
        finally:
            self.settings[tl.P_INITIALIZE] = place

    def set_budget(self, budget: float) -> None:
        """What the steps that follow may take, in units of work (`kernels/bayes_tree/work.py`), before they defer the
        rest; math.inf: they have no bound.
        """
        self.settings[tl.P_BUDGET] = PLANNED * budget

    def clear(self) -> None:
        """Let go of everything: the next step takes in the whole graph."""
        self.node: I64 = lines((256, tl.N_WIDTH), np.int64)
        self.link: I64 = lines((512, tl.L_WIDTH), np.int64)
        self.clique: I64 = lines((256, tl.C_WIDTH), np.int64)
        self.motions: F64 = lines(256 * tl.M_WIDTH, np.float64)
        self.lists: I64 = np.empty(4096, np.int64)
        self.numbers: F64 = pages.zeros(16384)
        self.hessian: F64 = pages.zeros(16384)
        self.lin: F64 = np.empty((3, 1024))
        self.scalars: F64 = np.zeros((3, 1024))
        self.factor_errors: F64 = lines((512, tl.E_WIDTH), np.float64)
        self.turns: F64 = lines((256, tl.U_WIDTH), np.float64)
        self.pending: I64 = np.empty(256, np.int64)
        self.changed: I64 = np.empty(256, np.int64)
        self.moved: I64 = np.empty(256, np.int64)
        self.marked: I64 = np.empty(256, np.int64)
        self.scratch: I64 = np.ones(WORDS, np.int64)
        self.saved: F64 = np.empty((16, SAVED))
        self.state: I64 = np.zeros(tl.S_SIZE, np.int64)
        self.totals: F64 = np.zeros(tl.T_SIZE)
        self.state[tl.S_FREE_CLIQUE], self.state[tl.S_RELINEARIZED_AT] = -1, -self._rest
        self.state[tl.S_NUMBERS] = fr.SCRATCH

    def step(self, sure: bool = False) -> int:
        """Take in what is new in the graph and solve; gives a status: DONE, UNSURE, FAILED, INFINITE.

        UNSURE: only the numbers can tell whether everything new is held; the next call is to be with `sure`.  FAILED:
        the pivot of variable `failed` was not positive.  INFINITE: the χ² of a new factor is beyond numbers.  After
        these nothing has changed, and the graph has to forget what is new where it is to be refused.
        """
        if sure:
            self.state[tl.S_CHECKED] = 1
        while (status := tree_step(self._graph.array_table, self.array_table, TASK_QUEUE, NOBODY)) == tl.NO_ROOM:
            self.make_room()
        return status

    @property
    def rises(self) -> bool:
        """Whether the last round of the step raised χ², so that it went no further."""
        return self.state.item(tl.S_RISES) != 0

    @property
    def raised(self) -> bool:
        """Whether pivots were raised, so that R alone does not lead to the optimum."""
        return self.state.item(tl.S_RAISED) != 0

    @property
    def deferred(self) -> int:
        """Variables that were due to be relinearized in the last step, and were not."""
        return int(self.state[tl.S_PENDING]) if self.state[tl.S_DUE] else 0

    @property
    def behind(self) -> bool:
        """Whether back-substitution left a part of the map where it was."""
        return self.state.item(tl.S_BEHIND) != 0

    @property
    def slow(self) -> bool:
        """Whether the last step left more than is called converged, by what the tree knows, and not for a budget."""
        return self.state.item(tl.S_SLOW) != 0

    @property
    def failed(self) -> int:
        """The variable whose pivot made the last step fail."""
        return int(self.state[tl.S_FAILED])

    @property
    def has_moved(self) -> bool:
        """Whether the last step moved linearization points: it did not where Λ could not be eliminated at new ones."""
        return self.state.item(tl.S_RELINEARIZED) > 0

    def move_all(self, damped: int = 0) -> None:
        """The next step moves the linearization points of all variables to the estimate; damped: 0, or DAMPED, where it
        damps all pivots, as later ones do."""
        var = self._graph.var[: self.state[tl.S_VARIABLES]]
        free = np.flatnonzero(var[:, at.V_COLUMN] >= 0)
        self.node[free, tl.N_FLAGS] = 1
        self.pending[: free.size] = free
        self.state[tl.S_PENDING] = free.size
        self.state[[tl.S_DUE, tl.S_ONCE]] = 1
        self.state[tl.S_RAISED] = damped

    def follow(self, damped: int, diagonal: Callable[[], F64]) -> None:
        """Eliminate everything at the estimate, and make a step from there: damped by `damped`, or DAMPED where a pivot
        was raised then or had failed.  diagonal: gives that of Λ at the estimate.
        """
        values = self._graph.values[: self._graph.counts[at.VALUES]]
        there = values.copy()
        self.move_all(damped)
        self.step()
        if self.has_moved and self.state.item(tl.S_RAISED) != tl.RAISED_PIVOT:
            return
        if self.has_moved:
            self.reset_to_linearization()
        values[:] = there
        # Pivots are judged by the diagonal of Λ, and the tree knows that as it was when factors came.
        self.note_diagonal(diagonal())
        self.move_all(tl.DAMPED)
        self.step()
        if not self.has_moved:
            self.totals[tl.T_CHI2] = math.inf

    def note_diagonal(self, diagonal: F64) -> None:
        """The diagonal of Λ at the estimate, where the next step moves all."""
        self.scalars[1, : diagonal.size] = diagonal
        self.totals[tl.T_LARGEST_DIAGONAL] = diagonal.max(initial=0.0)

    def reset_to_linearization(self) -> None:
        """Put the estimate back to the linearization points: the solution of the linear problem is not taken."""
        reset_to_linearization(self._graph.array_table, self.array_table)

    def remaining(self, most: float) -> float:
        """What the next Gauss-Newton step would take off χ², where R is not that of Λ; above `most`: that or more."""
        return float(remaining_decrement(most, self._graph.array_table, self.array_table))

    def list_changed(self, first_new: int) -> I64:
        """Variables whose estimate the last step gave other bits, and those from index `first_new` on, ascending."""
        graph = self._graph
        found = np.empty(self.state.item(tl.S_CHANGED) + graph.counts.item(at.VARIABLES) - first_new, np.int64)
        return found[: list_changed(first_new, graph.array_table, self.array_table, found)]

    def exchange(self) -> None:
        """Exchange the estimate and the one from before the last step, of the variables that it changed."""
        changed = self.changed[: self.state[tl.S_CHANGED]]
        exchange(changed, self._graph.var, self.lin, self._graph.values)

    def memory_bytes(self) -> int:
        """Bytes in use of all arenas."""
        variables, factors, cliques, lists, numbers, hessian = (
            int(self.state[entry])
            for entry in (tl.S_VARIABLES, tl.S_FACTORS, tl.S_CLIQUES, tl.S_LISTS, tl.S_NUMBERS, tl.S_HESSIAN)
        )
        counts = self._graph.counts
        rows = variables * (tl.N_WIDTH + tl.U_WIDTH + 3) + factors * (tl.L_WIDTH + tl.E_WIDTH)
        rows += cliques * (tl.C_WIDTH + tl.M_WIDTH)
        columns = 3 * int(counts[at.VALUES]) + 3 * int(counts[at.SCALARS])
        return 8 * (rows + columns + lists + numbers + hessian)

    def in_use(self) -> dict[str, slice | tuple[slice, slice]]:
        """What a copy needs of the arenas that grow with the graph, and of those that are by far the largest."""
        entries, counts = (tl.S_VARIABLES, tl.S_FACTORS, tl.S_NUMBERS, tl.S_HESSIAN), self._graph.counts
        variables, factors, numbers, hessian = (slice(int(self.state[entry])) for entry in entries)
        values, scalars = (slice(int(counts[entry])) for entry in (at.VALUES, at.SCALARS))
        together = dict.fromkeys(("node", "turns", "pending", "changed", "moved"), variables)
        of_graph = together | {"lin": (slice(None), values), "scalars": (slice(None), scalars)}
        of_factors = {"link": factors, "factor_errors": factors, "saved": slice(0)}
        return of_graph | of_factors | {"numbers": numbers, "hessian": hessian}

    def make_room(self) -> None:
        self._make_room_for_graph()
        state = self.state
        if (need := int(state[tl.S_NEED_CLIQUES])) > len(self.clique):
            self.clique = with_room(self.clique, need)
            self.motions = with_room(self.motions, len(self.clique) * tl.M_WIDTH)
        if len(self.clique) > self.marked.size:
            self.marked = np.empty(len(self.clique), np.int64)
        if (need := int(state[tl.S_NEED_LISTS])) > self.lists.size:
            self.lists = with_room(self.lists, need)
        if (need := int(state[tl.S_NEED_NUMBERS])) > self.numbers.size:
            pages.enlarge(self, "numbers", roomy(need, self.numbers.size))
        state[tl.S_NEED_CLIQUES : tl.S_NEED_NUMBERS + 1] = 0

    def _make_room_for_graph(self) -> None:
        """Of the arenas by variable and by factor, as `kernels/bayes_tree/begin_step.py` looks for it."""
        counts = self._graph.mark()
        variables, factors = counts[at.VARIABLES], counts[at.FACTORS]
        if variables > len(self.node):
            self.node, self.turns, self.pending, self.changed, self.moved = (
                with_room(array, variables) for array in (self.node, self.turns, self.pending, self.changed, self.moved)
            )
        if factors > len(self.link):
            self.link, self.factor_errors = with_room(self.link, factors), with_room(self.factor_errors, factors)
        if counts[at.VALUES] > self.lin.shape[1]:
            self.lin = _widened(self.lin, counts[at.VALUES])
        if counts[at.SCALARS] > self.scalars.shape[1]:
            self.scalars = _widened(self.scalars, counts[at.SCALARS])
        new = factors - int(self.state[tl.S_FACTORS])
        if (need := int(self.state[tl.S_HESSIAN]) + new * MOST_ROOM) > self.hessian.size:
            pages.enlarge(self, "hessian", roomy(need, self.hessian.size))
        if 2 * new > len(self.saved):
            self.saved = np.empty((4 * new, SAVED))


def settings_of(options: Options) -> F64:
    """The settings of a step, by their entries in `layout`."""
    tuning, settings = options.tuning, np.empty(tl.P_SIZE)
    settings[tl.P_WILDFIRE_THRESHOLD] = options.wildfire_threshold
    settings[tl.P_RELINEARIZE_THRESHOLD] = options.relinearize_threshold
    settings[tl.P_CONVERGED], settings[tl.P_MAX_ROUNDS] = options.converged_share, options.max_rounds
    settings[tl.P_BUDGET] = math.inf
    settings[tl.P_INITIALIZE] = _FEW if options.initialize_locally else -1
    settings[tl.P_CHI2_EPSILON] = tuning.chi2_epsilon
    settings[tl.P_NEXT_STEP_SHARE] = tuning.relinearize_next_step_share
    settings[tl.P_SAME_STEP_SHARE] = tuning.relinearize_same_step_share
    settings[tl.P_MAX_ERROR], settings[tl.P_MAX_WAIT] = tuning.relinearize_max_error, tuning.relinearize_max_wait
    settings[tl.P_FULL_BATCH] = tuning.relinearize_full_batch
    settings[tl.P_COOLDOWN_STEPS] = tuning.relinearize_cooldown_steps
    settings[tl.P_COOLDOWN_FACTOR] = tuning.relinearize_cooldown_factor
    settings[tl.P_COOLDOWN_FLOPS] = tuning.relinearize_cooldown_flops
    settings[tl.P_RECENT_STEPS] = tuning.constrain_recent_steps
    settings[tl.P_SPLIT_MIN_PIVOTS] = tuning.clique_split_min_pivots
    settings[tl.P_SPLIT_MAX_AFFECTED] = tuning.clique_split_max_affected
    settings[tl.P_REROOT_MIN_FLOPS], settings[tl.P_REROOT_PERIOD] = tuning.reroot_min_flops, tuning.reroot_period
    settings[tl.P_REROOT_SIZE_LINEAR] = tuning.reroot_size_linear
    settings[tl.P_REROOT_SIZE_AREA] = tuning.reroot_size_area
    settings[tl.P_REROOT_RING_RATIO], settings[tl.P_REROOT_MAX_EXTRA] = (
        tuning.reroot_ring_ratio,
        tuning.reroot_max_extra,
    )
    return settings


def _widened(array: F64, need: int) -> F64:
    """A copy with columns for at least `need`, and more for the next ones."""
    wider = np.zeros((len(array), roomy(need, array.shape[1])))
    wider[:, : array.shape[1]] = array
    return wider
