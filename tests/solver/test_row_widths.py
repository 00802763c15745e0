"""Arrays of rows have the widths that kernels compute with."""

from naive.solver_parts import graph_in, tree_of

from factorbus.simulate import WORLDS
from factorbus.solver import Solver
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.records import fields_of
from factorbus.solver.kernels.model.records import Graph


def test_arrays_have_the_columns_that_records_say() -> None:
    """What a record says of its arrays is built into the kernels: an array of another width would be read wrongly."""
    solver = Solver()
    for step in WORLDS["city_trees"](30, 1):
        solver.stage(step.batch)
        solver.step()
    told = 0
    for record, holder in ((Graph, graph_in(solver)), (Tree, tree_of(solver))):
        for name, field in fields_of(record).items():
            if field.columns:
                assert getattr(holder, name).shape[1] == field.columns, name
                told += 1
    assert told >= 7
