"""The solver of factorbus: pure mathematics, no bus, clock, thread, file or print.

`service/MATH.md` has the equations.

    solver = Solver(Options(clock=time.perf_counter))
    solver.stage(batch)
    report = solver.step()
    solver.estimate()
"""

from factorbus.solver import errors
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.groups import FactorGroup, Group
from factorbus.solver.kernels.jit.compile import compile_seconds
from factorbus.solver.kernels.jit.releases import why_stock as why_stock_numba
from factorbus.solver.optimize.evaluate import chi2_at
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver
from factorbus.solver.starts.batch import BatchResult, solve_batch
from factorbus.solver.starts.search import BatchEvents, BatchSearch
from factorbus.solver.tuning import Tuning
from factorbus.solver.warm import warm

__all__ = [
    "BatchEvents",
    "BatchResult",
    "BatchSearch",
    "FactorGroup",
    "Group",
    "Options",
    "Solver",
    "SolverError",
    "StepReport",
    "Tuning",
    "chi2_at",
    "compile_seconds",
    "errors",
    "solve_batch",
    "warm",
    "why_stock_numba",
]
