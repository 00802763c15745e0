"""Changes of a map: a solver of the changed map, or the same solver after a step that changed it.  MATH §11."""

from collections.abc import Sequence
from contextlib import nullcontext

from factorbus.solver.changes.convert_to_points import pick_features, with_points
from factorbus.solver.changes.edited import edited
from factorbus.solver.changes.in_place import try_in_place
from factorbus.solver.changes.requested import ChangeLike, collect
from factorbus.solver.errors import Underconstrained
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition, BatchLike
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver

_OF_MARGINALS = (
    "what is marginalized may have been all that says where the map is, and so much less well than it says where "
    "variables are to each other that a linear factor cannot hold it: keep it, or add a better prior first"
)


def with_changes(
    solver: Solver,
    changes: Sequence[ChangeLike],
    batch: BatchLike | None = None,
    settle: bool = False,
    within: bool = False,
) -> tuple[Solver, int, StepReport, dict[str, int]]:
    """A solver of the same map with `changes` made, in their order, and then `batch` added; `solver` stays as it is.

    Gives it, the id of the first factor of `batch`, the report of its first step, and what was changed.  That step
    relinearizes everything at the estimate and eliminates all anew, whatever the mode; `within`: and goes no further
    than the bounds of numbers let it.  Nothing may be staged.  Raises as `changes.collect`, `stage` and `step` do.
    """
    edits = collect(solver._graph, changes)
    made = _taken_over(solver, edited(solver._graph, edits))
    if edits.added:
        admit(made._graph, Addition((), edits.added))
    before = made.variable_count, made.factor_count
    first = made._graph.next_id if batch is None else made.stage(batch)
    new = made.variable_count - before[0], made.factor_count - before[1]
    with made.within_bounds() if within else nullcontext():
        try:
            report = made._stepper.resume(settle)
        except Underconstrained as error:
            if not edits.added:
                raise
            key, factors, missing = (error.detail[name] for name in ("key", "factors", "missing"))
            raise Underconstrained(key, factors, f"{missing}; {_OF_MARGINALS}") from None
    report = report._replace(new_variables=new[0], new_factors=new[1])
    return made, first, report, edits.counted


def try_change(
    solver: Solver, changes: Sequence[ChangeLike], batch: BatchLike | None = None, settle: bool = False
) -> tuple[int, StepReport, dict[str, int]] | None:
    """Make `changes` of factors, add `batch`, and step, in this solver: it eliminates what they touch, no more.

    Gives what `with_changes` gives but for the solver.  None: only that can make them, or say why not; then nothing has
    changed.  So it is where they remove, fix, free, place or marginalize variables, where something would be free to
    move, with `settle`, and in modes other than "bayes-tree".  Nothing may be staged.  Raises as `changes.collect` and
    `stage` do.
    """
    if settle:
        return None
    edits, graph = collect(solver._graph, changes), solver._graph
    came = try_in_place(graph, solver._stepper, edits, lambda: graph.next_id if batch is None else solver.stage(batch))
    return None if came is None else (*came, edits.counted)


def with_converted(solver: Solver, keys: I64) -> tuple[Solver, StepReport]:
    """A solver in which these features are points, under their keys, and its first step; `solver` stays as it is.

    Later observations of them may still be sent as `idp_seen`.  Raises UnknownVariable, KindMismatch, and what `step`
    does.
    """
    made = _taken_over(solver, with_points(solver._graph, pick_features(solver._graph, keys)))
    return made, made._stepper.resume(False)


def _taken_over(solver: Solver, graph: FactorGraph) -> Solver:
    """A solver with the options of this one that has this graph, and has not solved it."""
    made = Solver(solver._options)
    made._graph.take(graph)
    return made
