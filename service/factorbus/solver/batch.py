"""A whole graph at once, from the values given: what a worker computes to compare an incremental estimate with."""

from collections.abc import Sequence
from dataclasses import dataclass

from factorbus.solver.groups import FactorsLike, Group, VariablesLike
from factorbus.solver.options import Options
from factorbus.solver.solver import Solver


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The optimum: χ² there, the iterations it took, the values of all variables, and whether it converged."""

    chi2: float
    iterations: int
    values: list[Group]
    converged: bool


@dataclass(frozen=True, slots=True)
class _Batch:
    variables: Sequence[VariablesLike]
    factors: Sequence[FactorsLike]


def solve_batch(variables: Sequence[VariablesLike], factors: Sequence[FactorsLike]) -> BatchResult:
    """Gauss-Newton (Levenberg-Marquardt where needed) from the given values until converged.

    Variables without values are composed from the first factor that reaches them.  Raises SolverError.
    """
    solver = Solver(Options(mode="all-batch"))
    solver.stage(_Batch(tuple(variables), tuple(factors)))
    report = solver.step(settle=True)
    return BatchResult(report.chi2, report.iterations, solver.estimate(), report.converged)
