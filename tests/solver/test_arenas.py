"""The table of addresses that kernels find arrays by tells of the arrays that are there now."""

import copy
import pickle

import numpy as np
import pytest
from naive.solver_parts import graph_in
from naive.tree_records import tree_of

from factorbus.solver import Solver
from factorbus.solver.graph.arenas import Arenas, lines
from factorbus.solver.kernels.bayes_tree import records as bayes_tree
from factorbus.solver.kernels.jit.array_table import WIDTH
from factorbus.solver.kernels.model import records as model


class Two(Arenas):
    ARENAS = ("first", "second")

    def __init__(self) -> None:
        self.first, self.second = np.arange(3), np.zeros((4, 2))
        self.other = np.zeros(2)


def rows(thing: Arenas) -> list[tuple[int, ...]]:
    return [tuple(row) for row in thing.array_table.reshape(-1, WIDTH).tolist()]


def of(array: np.ndarray) -> tuple[int, ...]:
    return (array.ctypes.data, *array.shape, 1)[:WIDTH]


def test_it_has_address_and_shape_of_each() -> None:
    two = Two()
    assert rows(two) == [of(two.first), of(two.second)]
    assert two.array_table is two.array_table


def test_it_follows_an_assignment() -> None:
    two = Two()
    table = two.array_table
    two.other = np.zeros(5)
    assert two.array_table is table
    two.second = np.ones((8, 2))
    assert rows(two) == [of(two.first), of(two.second)]


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda two: pickle.loads(pickle.dumps(two))])
def test_a_copy_has_one_of_its_own(again) -> None:
    two = Two()
    other = again(two)
    assert rows(other) == [of(other.first), of(other.second)]
    other.first = np.zeros(9)
    assert rows(two) == [of(two.first), of(two.second)]


@pytest.mark.parametrize("wrong", [np.zeros((4, 4))[:, 1], np.zeros(3, np.float32), np.zeros((2, 2, 2)), np.array(1.0)])
def test_what_no_kernel_could_work_on_is_refused(wrong: np.ndarray) -> None:
    two = Two()
    before = rows(two)
    with pytest.raises(TypeError, match="first is"):
        two.first = wrong
    assert rows(two) == before == [of(two.first), of(two.second)]


def test_those_of_a_solver_are_there_and_as_its_kernels_read_them() -> None:
    solver = Solver()
    tree = tree_of(solver)
    for thing, names in ((graph_in(solver), model.Graph._fields), (tree, bayes_tree.Tree._fields)):
        assert rows(thing) == [of(getattr(thing, name)) for name in names]
    graph, looked_up = model.graph_at(graph_in(solver).array_table), bayes_tree.tree_at(tree.array_table)
    assert all(np.shares_memory(getattr(graph, name), getattr(graph_in(solver), name)) for name in graph._fields)
    assert all(np.shares_memory(getattr(looked_up, name), getattr(tree, name)) for name in looked_up._fields)


def test_rows_begin_with_cache_lines() -> None:
    for shape in (8, (3, 8), (1000, 24), (5, 3)):
        made = lines(shape, np.int64)
        assert made.ctypes.data % 64 == 0
        assert made.shape == (shape if isinstance(shape, tuple) else (shape,))
        assert not made.any()


@pytest.mark.parametrize("few", [True, False])
def test_what_grew_still_does(few: bool) -> None:
    solver = Solver()
    if not few:
        graph_in(solver).reserve_variables(5000, 15000)
        graph_in(solver).reserve_factors(5000, 45000)
    graph = graph_in(solver)
    assert graph.var.ctypes.data % 64 == 0
    assert graph.fac.ctypes.data % 64 == 0
