"""Records of a few arrays, for parts of kernels that read no others."""

from typing import Any

import numpy as np

from factorbus.solver.graph.arenas import Arenas
from factorbus.solver.kernels.bayes_tree.records import Tree, tree_at
from factorbus.solver.kernels.jit.records import fields_of
from factorbus.solver.kernels.model.records import Graph, graph_at


def graph_of(arrays: dict[str, np.ndarray]) -> Graph:
    """The graph with these of its arrays; the others are empty."""
    return _record_of(Graph, graph_at, arrays)


def tree_of(arrays: dict[str, np.ndarray]) -> Tree:
    """The tree with these of its arrays; the others are empty, and there is no room in `scratch`."""
    return _record_of(Tree, tree_at, {"scratch": np.ones(1, np.int64)} | arrays)


def _record_of(record: type, record_at: Any, arrays: dict[str, np.ndarray]) -> Any:
    holder: Any = type("Holder", (Arenas,), {"ARENAS": record._fields})()
    for name, (kind, dimensions, _columns) in fields_of(record).items():
        setattr(holder, name, arrays.get(name, np.zeros((0,) * dimensions, kind)))
    made = record_at(holder.array_table)
    made.holder = holder
    return made
