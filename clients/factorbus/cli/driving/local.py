"""A map in this process, without a bus: the same solver, for `replay --in-process`."""

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.cli.driving.drive import Compared, DriveStep
from factorbus.cli.driving.optimum import as_messages
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.solver import Options, Solver, compile_seconds, solve_batch
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks

if TYPE_CHECKING:
    from factorbus.formats import FileNotes


class LocalMap:
    """A solver of our own."""

    def __init__(self, mode: str = "auto") -> None:
        self._solver = Solver(Options(mode=mode, clock=time.perf_counter))
        self._revision = 0
        self._cpu_s = 0.0
        self._compared: list[Compared] = []

    def send(self, batch: Batch) -> list[DriveStep]:
        """Stage and step.  Raises SolverError."""
        start = time.thread_time()
        self._solver.stage(batch)
        return [self._step(start, settle=False)]

    def flush(self) -> list[DriveStep]:
        """Nothing is ever out."""
        return []

    def settle(self) -> DriveStep:
        """Iterate until converged."""
        return self._step(time.thread_time(), settle=True)

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate."""
        return self._solver.chi2()

    def compare(self) -> None:
        """Solve the same graph from scratch, here and now: the drive waits."""
        self._compared.append(replace(self.optimum(), variables=()))

    def optimum(self) -> Compared:
        """The same, and the optimum itself."""
        start = time.perf_counter()
        batch = solve_batch(*self._solver.graph())
        seconds, chi2 = time.perf_counter() - start, self._solver.chi2()
        values = as_messages(batch.values)
        return Compared(self._revision, chi2, batch.chi2, "in-process", seconds, batch.start, values, batch.converged)

    def adopt(self, found: Compared) -> DriveStep:
        """Go to an optimum, and settle there."""
        start = time.thread_time()
        changes = [Change("place", keys=g.keys, kind=g.kind, values=g.values, carry=True) for g in found.variables]
        self._solver, _, report, counted = with_changes(self._solver, changes, settle=True)
        self._cpu_s += time.thread_time() - start
        self._revision += 1
        return DriveStep(self._revision, report.as_dict() | counted, None)

    def compared(self) -> list[Compared]:
        """All comparisons."""
        return self._compared

    def estimate(self) -> tuple[Variables, ...]:
        """A copy of all variables."""
        return as_messages(self._solver.estimate())

    def graph(self) -> Batch:
        """A copy of all variables and factors."""
        variables, factors = self._solver.graph()
        return Batch(
            as_messages(variables),
            tuple(Factors(g.kind, g.keys, g.measured, g.information, g.loss, g.scale) for g in factors),
        )

    def closures_out(self) -> "FileNotes":
        """None: closures are trusted here."""
        from factorbus.formats import FileNotes

        return FileNotes()

    def summary(self) -> dict[str, Any]:
        """CPU seconds of this thread in the solver, seconds of compiling."""
        return {
            "solver_cpu_s": self._cpu_s,
            "kernels_compiled_s": compile_seconds(),
            "deltas": None,
            "closure_states": None,
        }

    def _step(self, start: float, settle: bool) -> DriveStep:
        report = self._solver.step(settle=settle).as_dict()
        self._cpu_s += time.thread_time() - start
        self._revision += 1
        return DriveStep(self._revision, report, None)


def chi2_unsolved(batches: Iterable[Batch]) -> float:
    """χ² of the whole graph with every variable as composed from the first factor that reaches it."""
    solver = Solver(Options(mode="inc-l", max_iterations=0))
    for batch in batches:
        solver.stage(batch)
    return solver.step().chi2


def covariances_at(graph: Batch, keys: I64) -> dict[int, F64]:
    """Key → covariance of its tangent, of some variables of a graph, linearized at the values that it has.

    Raises SolverError.
    """
    solver = Solver(Options(mode="inc-l", max_iterations=0))
    solver.stage(graph)
    solver.step()
    blocks = CovarianceBlocks(solver.covariances.factored())
    place = {key: at for at, key in enumerate(blocks.factored.graph.keys[: blocks.factored.count].tolist())}
    found = blocks.of(np.array([place[key] for key in keys.tolist()], np.int64))
    dims = blocks.factored.dims
    return {key: block[: dims[place[key]], : dims[place[key]]] for key, block in zip(keys.tolist(), found, strict=True)}
