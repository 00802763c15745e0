"""Our solver as a contestant."""

from collections import Counter
from typing import Any

import numpy as np

from factorbus.proto.messages import Batch
from factorbus.solver import Group, Options, Solver, SolverError, StepReport

from .columns import Values
from .contestants import Failed


class Ours:
    """`Solver` in one of its modes; what is on the clock is stage, step and estimate."""

    def __init__(self, mode: str) -> None:
        self._options = Options(mode=mode)
        self._solver = Solver(self._options)
        self._batch = Batch()
        self._report: StepReport | None = None
        self._groups: list[Group] = []
        self._strategies: Counter[str] = Counter()
        self._sums: Counter[str] = Counter()
        self._nnz_r = 0

    def prepare(self, batch: Batch) -> None:
        """Nothing is built: columns are what the solver takes.  The last report is put into the statistics."""
        self._count()
        self._batch, self._groups = batch, []  # letting the old values go is not on the clock

    def step(self) -> None:
        """Raises Failed."""
        try:
            self._solver.stage(self._batch)
            self._report = self._solver.step()
        except SolverError as problem:
            raise Failed(f"{problem.code}: {problem}") from problem

    def read(self) -> None:
        """A copy of all values."""
        self._groups = self._solver.estimate()

    def settle(self) -> None:
        """Iterate until converged."""
        self._solver.step(settle=True)
        self._groups = self._solver.estimate()

    def values(self) -> Values:
        """The same per kind, fixed and free together."""
        return values_of(self._groups)

    def facts(self) -> dict[str, Any]:
        """nnz_r is of the last factor that was made; options: in force."""
        self._count()
        told = {"nnz_r": self._nnz_r or None, "strategies": dict(self._strategies), **self._sums}
        return {**told, "options": self._options.as_dict()}

    def _count(self) -> None:
        if self._report is not None:
            report, self._report = self._report, None
            self._strategies[report.strategy] += 1
            for name in ("iterations", "relinearized", "eliminated"):
                self._sums[name] += int(getattr(report, name))
            self._nnz_r = report.nnz_r or self._nnz_r


def values_of(groups: list[Group]) -> Values:
    """kind -> (keys, values) of all groups of the kind."""
    kinds = dict.fromkeys(group.kind for group in groups)
    return {
        kind: (
            np.concatenate([group.keys for group in groups if group.kind == kind]),
            np.concatenate([group.values for group in groups if group.kind == kind]),
        )
        for kind in kinds
    }
