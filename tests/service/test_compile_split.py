"""Who compiles what: each process keeps to what it knows."""

from pathlib import Path

import pytest

from factorbus.service.operations.compile_split import CompileSplit, functions_of
from factorbus.solver.kernels.bayes_tree import edit_factors
from factorbus.solver.kernels.bayes_tree import step as tree_step
from factorbus.solver.kernels.jit import compile as _jit
from factorbus.solver.kernels.model.kinds import residual_of

KERNELS = {"a": {"a1": 10, "a2": 10}, "a small": {"a1": 10}, "b": {"b1": 9, "b2": 2}, "b small": {"b1": 9, "a2": 10}}


def test_each_keeps_to_what_it_knows(tmp_path: Path) -> None:
    one, other = iter(CompileSplit(tmp_path, KERNELS)), iter(CompileSplit(tmp_path, KERNELS))
    assert [next(one), next(other), next(one), next(other)] == ["a", "b", "a small", "b small"]
    assert [list(one), list(other)] == [[], []]


def test_what_another_knows_is_taken_last_but_taken(tmp_path: Path) -> None:
    one, other = iter(CompileSplit(tmp_path, KERNELS)), iter(CompileSplit(tmp_path, KERNELS))
    assert next(one) == "a"
    assert list(other) == ["b", "b small", "a small"]
    assert list(one) == []


@pytest.mark.skipif(_jit.DISABLED, reason="without the compiler functions are not kernels")
def test_all_that_is_compiled_with_a_kernel() -> None:
    of_step = functions_of(tree_step.tree_step)
    assert tree_step.tree_step.py_func in of_step
    shared = of_step.keys() & functions_of(edit_factors.edit_factors).keys()
    assert len(shared) > 30, "the Hessian of every kind of factor"
    assert all(size > 0 for size in of_step.values())
    if not _jit.STOCK:
        assert residual_of.py_func not in of_step, "which calls it by its address"
