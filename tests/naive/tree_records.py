"""What the arenas of a tree of cliques say, checked against the graph."""

from dataclasses import dataclass

import numpy as np
from naive.solver_parts import graph_in, stepper_in, tree_of

from factorbus.solver import Solver
from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at

_DIM = {at.SE2: 3, at.SE3: 6, at.POINT2: 2, at.POINT3: 3, at.IDP: 6}


@dataclass(frozen=True)
class Clique:
    """One record: frontal and separator variables, parent, children."""

    frontals: list[int]
    separator: list[int]
    parent: int
    children: list[int]


def stays_at_linearization(solver: Solver) -> bool:
    """Whether its estimate was left where the tree is linearized: R waits for the next step to be used."""
    stepper = stepper_in(solver)
    assert isinstance(stepper, TreeSteps)
    return stepper._at_linearization  # no step tells: the next one does as much work either way


def cliques(solver: Solver) -> dict[int, Clique]:
    """The cliques that hold the free variables."""
    tree, var = tree_of(solver), graph_in(solver).var
    free = [v for v in range(solver.variable_count) if var[v, at.V_COLUMN] >= 0]
    found = {}
    for c in sorted({int(tree.node[v, tl.N_CLIQUE]) for v in free}):
        row = tree.clique[c]
        start, frontals = row[tl.C_LIST], row[tl.C_FRONTALS]
        names = tree.lists[start : start + frontals + row[tl.C_SEPARATORS]].tolist()
        children, child = [], int(row[tl.C_CHILD])
        while child >= 0:
            children.append(child)
            child = int(tree.clique[child, tl.C_NEXT])
        found[c] = Clique(names[:frontals], names[frontals:], int(row[tl.C_PARENT]), children)
    return found


def assert_is_a_tree(solver: Solver) -> dict[int, Clique]:
    """Every free variable is a frontal once, every separator lies in its parent, every factor has one owner."""
    tree, graph = tree_of(solver), graph_in(solver)
    found = cliques(solver)
    frontals = sorted(v for clique in found.values() for v in clique.frontals)
    assert frontals == [v for v in range(solver.variable_count) if graph.var[v, at.V_COLUMN] >= 0]
    for c, clique in found.items():
        row = tree.clique[c]
        assert [int(tree.node[v, tl.N_PLACE]) for v in clique.frontals] == list(range(len(clique.frontals)))
        assert sum(_DIM[int(graph.var[v, at.V_KIND])] for v in clique.frontals) == row[tl.C_PIVOTS]
        assert sum(_DIM[int(graph.var[v, at.V_KIND])] for v in clique.separator) == row[tl.C_SEPARATOR_SCALARS]
        assert all(found[child].parent == c for child in clique.children)
        if clique.parent < 0:
            assert not clique.separator
        else:
            above = found[clique.parent]
            assert set(clique.separator) <= {*above.frontals, *above.separator}
            assert c in above.children
            places = [above.frontals.index(v) for v in clique.separator if v in above.frontals]
            assert min(places) == row[tl.C_ABOVE]
    assert int(tree.state[tl.S_ALIVE]) == len(found)
    assert int(tree.state[tl.S_ROOTS]) == sum(clique.parent < 0 for clique in found.values())
    assert_factors_have_owners(solver)
    return found


def assert_factors_have_owners(solver: Solver) -> None:
    """Each factor on a free variable is in the list of one of its variables."""
    tree, graph = tree_of(solver), graph_in(solver)
    owned = []
    for v in range(solver.variable_count):
        f = int(tree.node[v, tl.N_OWN])
        while f >= 0:
            assert v in graph.fac[f, [at.F_I, at.F_J]]
            owned.append(f)
            f = int(tree.link[f, tl.L_OWN])
    ends = graph.fac[: solver.factor_count, [at.F_I, at.F_J]]
    free = ((ends >= 0) & (graph.var[ends, at.V_COLUMN] >= 0)).any(axis=1)
    assert sorted(owned) == np.flatnonzero(free).tolist()
