"""A search for the optimum of a whole graph that gives up early."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from factorbus.solver.starts import descent
from factorbus.solver.starts.search import BatchSearch


def give_up_after(tries: int, put: Callable[[Any, str, Any], None]) -> None:
    """Each start has this number of tries.  put: `setattr`, or one that takes it back afterwards."""
    begin = descent.Descents.__init__

    def begin_with_few(self: Any, graph: Any, search: BatchSearch | None = None, *more: Any) -> None:
        begin(self, graph, replace(search or BatchSearch(), max_iterations=tries), *more)

    put(descent.Descents, "__init__", begin_with_few)
    put(descent, "_CHUNK", min(tries, descent._CHUNK))
    put(descent, "_FIRST_CHUNK", min(tries, descent._FIRST_CHUNK))
