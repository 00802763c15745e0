"""Factors that go, or get another weight or loss, in the solver that has them: what a step changes, and no more.
MATH §11.5.

    1  payload    measurements stay where they are; a factor that gets a loss has no room for its scale, and is copied
    2  tree       what goes is taken off the lists of its variables, what stays is linearized anew (`edit_factors`)
    3  rows       what is behind a factor that goes moves up (`remove_rows`); ids stay

Until the step is made all of it can be undone, bit for bit.  What cannot be done so is left to `with_changes`.
"""

import copy
from dataclasses import dataclass

import numpy as np

from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.changes.requested import Edits
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_ids import Ids
from factorbus.solver.graph.factor_rows import is_first, losses_of, rows_of_arities, with_losses
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.edit_factors import LOG_WIDTH, MOST_LINKS, edit_factors, relink
from factorbus.solver.kernels.bayes_tree.hessian_room import JACOBIAN, hessian_size
from factorbus.solver.kernels.bayes_tree.remove_rows import close_gaps, open_gaps
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import BEHIND
from factorbus.solver.kernels.model.kinds import CAMERA
from factorbus.solver.kernels.model.preintegration import ROOM
from factorbus.solver.sparse.anchors import find_undetermined

# What nobody has any more of the payload or of the Hessians, as a share of all: with more everything is packed anew.
_MOST_HOLES = 0.5
# Changes of anything else than factors.
_OTHERS = ("removed_variables", "fixed_variables", "freed_variables", "placed_variables", "added_factors")
_COUNTED = (tl.S_EXACT, tl.S_INACTIVE, tl.S_HOLES, tl.S_EDITED_AT)


@dataclass(frozen=True, slots=True)
class _Before:
    """What an edit is about to change, as it was."""

    counted: I64
    totals: F64
    fac: I64
    link: I64
    factor_errors: F64
    ends: I64
    diagonals: list[F64]
    levers: F64
    hessians: list[F64]
    weighed: list[F64]
    ids: Ids
    holes: int


class FactorEdit:
    """Factors `gone` and `renewed` (rows, ascending) of a graph and its tree.  `make` it, step, and `undo` it where
    that failed.
    """

    def __init__(self, graph: FactorGraph, tree: CliqueTree, edits: Edits) -> None:
        self._graph, self._tree, self._edits = graph, tree, edits
        self.gone: I64 = np.flatnonzero(~edits.kept)
        self.renewed: I64 = np.flatnonzero(edits.kept & edits.touched)
        first = is_first(graph.fac[: edits.kept.size])
        # Factors gone and renewed, and the rows gone that are not the first of their factors.
        self.counts = int(first[self.gone].sum()), int(first[self.renewed].sum())
        self.members = self.gone.size - self.counts[0]
        self._log: I64 = np.empty((MOST_LINKS * self.gone.size, LOG_WIDTH), np.int64)
        self._linked = 0
        self._closed = False
        self._rows: I64 = np.concatenate([self.gone, self.renewed])
        self._before: _Before | None = None

    @property
    def is_possible(self) -> bool:
        """Whether nothing else is changed, and a step can do it."""
        graph, state, counted = self._graph, self._tree.state, self._edits.counted
        if any(counted[each] for each in _OTHERS) or not self._rows.size or state[tl.S_RAISED]:
            return False
        hollow = state[tl.S_HOLES] > _MOST_HOLES * state[tl.S_HESSIAN]
        if hollow or graph.holes > _MOST_HOLES * graph.counts[at.PAYLOAD]:
            return False
        return not self.gone.size or self._are_determined()

    def make(self) -> bool:
        """Change graph and tree, ahead of a step; False: a χ² is beyond numbers, `undo` it."""
        graph, tree = self._graph, self._tree
        self._before = self._remember()
        for row in self.renewed[is_first(graph.fac[self.renewed])].tolist():
            self._rewrite(row)
        linked = int(edit_factors(self.gone, self.renewed, graph.array_table, tree.array_table, self._log))
        self._linked = linked if linked >= 0 else -1 - linked
        if self.gone.size:
            graph.drop_ids(self.gone)
            graph.holes += int(self._widths(self.gone).sum())
            close_gaps(self.gone, graph.array_table, tree.array_table)
            graph.counts[at.MEMBERS] -= self.members
            self._closed = True
        return linked >= 0

    def undo(self) -> None:
        """As it was before `make`; new variables and factors are to be forgotten first."""
        graph, tree, before = self._graph, self._tree, self._before
        if before is None:
            return
        if self._closed:
            open_gaps(self.gone, graph.array_table, tree.array_table)
            graph.counts[at.MEMBERS] += self.members
        graph.put_ids(before.ids)
        graph.forget_ids()
        graph.holes = before.holes
        graph.fac[self._rows] = before.fac
        for row, numbers in zip(self.renewed.tolist(), before.weighed, strict=True):
            start = graph.fac[row, at.F_AT]
            graph.payload[start : start + numbers.size] = numbers
        tree.link[self._rows], tree.factor_errors[self._rows] = before.link, before.factor_errors
        relink(self._linked, self._log, tree.array_table)
        for row, hessian in zip(self.renewed.tolist(), before.hessians, strict=True):
            start = tree.link[row, tl.L_AT]
            tree.hessian[start : start + hessian.size] = hessian
        for v, diagonal in zip(before.ends.tolist(), before.diagonals, strict=True):
            start = graph.var[v, at.V_SCALAR]
            tree.scalars[1, start : start + diagonal.size] = diagonal
        tree.turns[before.ends, tl.U_LEVER] = before.levers
        tree.totals[:], tree.state[list(_COUNTED)] = before.totals, before.counted
        tree.node[tree.moved[: tree.state[tl.S_MOVED]], tl.N_LISTED] = 0
        tree.state[[tl.S_MOVED, tl.S_EDITED]] = 0
        self._before = None

    def _are_determined(self) -> bool:
        """Whether the factors that stay hold what the others were on, by the rules for what is new (MATH §7).

        What of the map is held by its numbers alone is then still held: a direction in which it could move would have
        to leave these variables where they are, and no factor on any other one goes.
        """
        graph, kept = self._graph, copy.copy(self._graph)
        kept.fac, kept.counts = graph.fac[: self._edits.kept.size][self._edits.kept], graph.counts.copy()
        kept.counts[at.FACTORS] = len(kept.fac)
        ends = graph.fac[self.gone, at.F_I : at.F_J + 1]
        return not np.isin(ends, find_undetermined(kept, (0,) * at.COUNTS)).any()

    def _remember(self) -> _Before:
        graph, tree = self._graph, self._tree
        fac, link = graph.fac[self._rows], tree.link[self._rows]
        ends = np.unique(fac[:, at.F_I : at.F_J + 1])
        ends = ends[ends >= 0]
        diagonals, hessians, weighed = [], [], []
        for scalar, kind in graph.var[ends][:, [at.V_SCALAR, at.V_KIND]].tolist():
            size = VARIABLE_KIND_OF_CODE[kind].dim if scalar >= 0 else 0
            diagonals.append(tree.scalars[1, max(scalar, 0) : max(scalar, 0) + size].copy())
        for row in self.renewed.tolist():
            dims = [VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])].dim if v >= 0 else 0 for v in _pair(graph, row)]
            start, size = int(tree.link[row, tl.L_AT]), hessian_size(dims[0], dims[1])
            size += _jacobian_size(graph, row)
            hessians.append(tree.hessian[start : start + size].copy())
            start = int(graph.fac[row, at.F_AT])
            weighed.append(graph.payload[start : start + int(self._widths(np.array([row]))[0])].copy())
        return _Before(
            tree.state[list(_COUNTED)],
            tree.totals.copy(),
            fac,
            link,
            tree.factor_errors[self._rows],
            ends,
            diagonals,
            tree.turns[ends, tl.U_LEVER],
            hessians,
            weighed,
            graph.kept_ids(),
            graph.holes,
        )

    def _rewrite(self, row: int) -> None:
        """The weight and loss of a factor that stays."""
        graph, edits = self._graph, self._edits
        kind, start = graph.kind_of(row), int(graph.fac[row, at.F_AT])
        loss = int(edits.loss[row])
        had, width = bool(losses_of(graph.fac[row]) != at.NO_LOSS), kind.width
        if loss != at.NO_LOSS and not had:
            graph.reserve_factors(1, width + 1)
            end = int(graph.counts[at.PAYLOAD])
            graph.payload[end : end + width] = graph.payload[start : start + width]
            graph.fac[row, at.F_AT] = end
            graph.counts[at.PAYLOAD] += width + 1
            graph.holes += width
            start = end
        elif had and loss == at.NO_LOSS:
            graph.holes += 1
        if loss != at.NO_LOSS:
            graph.payload[start + width] = edits.scale[row]
        if edits.weight[row] != 1.0:
            graph.payload[start + kind.information_at : start + width] *= edits.weight[row]
        graph.fac[row, at.F_FLAGS] = with_losses(graph.fac[row, at.F_FLAGS], loss)

    def _widths(self, rows: I64) -> I64:
        """How many numbers of the payload each of these factors has."""
        return sum(self._graph.sizes_of(rows)) + (losses_of(self._graph.fac[rows]) != at.NO_LOSS)


def _pair(graph: FactorGraph, row: int) -> list[int]:
    """The variables that a row joins; −1: no second one."""
    return graph.fac[row, at.F_I : at.F_J + 1].tolist()


def _jacobian_size(graph: FactorGraph, row: int) -> int:
    """Numbers of a Jacobian that are kept behind the Hessian of a row, as `hessian_room.jacobian_size` has it."""
    offset = int(graph.fac[row, at.F_FLAGS]) >> at.OFFSET_SHIFT & at.OFFSET_MASK
    head = row - offset
    ends = int(graph.fac[head, at.F_FLAGS]) >> at.ENDS_SHIFT & at.ENDS_MASK
    rows = int(rows_of_arities(np.array([ends]))[0])
    if not ends or offset != rows - 1 or CAMERA[graph.fac[head, at.F_KIND]]:
        return 0
    kind = graph.kind_of(head)
    size = kind.dim * (sum(end.dim for end in kind.connects) + 1) + BEHIND + (ROOM if kind.code == at.IMU else 0)
    return size if size <= JACOBIAN * rows else 0
