"""Whether new variables are held, where only the numbers can tell.  MATH §9.2"""

from collections.abc import Callable

from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.optimize.system import System
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.anchors import find_unanchored, find_undetermined
from factorbus.wording import counted


def check_determined(graph: FactorGraph, mark: Mark, make_system: Callable[[], System]) -> str:
    """Refuse variables that came since `mark` and that nothing holds; gives why the others were looked at, or "".

    make_system: all normal equations at the estimate.  Raises Underconstrained
    """
    suspects = find_undetermined(graph, mark)
    if not suspects.size:
        return ""
    free = find_unanchored(graph, mark)
    system = make_system()
    if free >= 0:
        raise system.underconstrained(
            free,
            "nothing joins it to a fixed variable or a prior; fix a variable, or add a prior or a factor to the "
            "rest of the map",
        )
    system.begin(suspects, Stopwatch(None))
    system.factorize(0.0)
    return f"only several factors together hold {counted(suspects.size, 'new variable')}"
