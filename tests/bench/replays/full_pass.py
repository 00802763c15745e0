"""A whole batch pass over a final system: ours, linearization included, against CHOLMOD without it.

ours      relinearize + order + analyse + factorize + solve
CHOLMOD   analyse (with its ordering) + factorize + solve, by scikit-sparse, of a matrix that is there already; the
          fastest of its modes and orderings counts

Both at the optimum that the reference found.  CHOLMOD is as fast as its BLAS: with the reference BLAS the comparison
would be none, so the BLAS is named.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from naive.block_systems import BlockSystem
from naive.solver_parts import graph_in, system_in
from scipy.sparse import csc_matrix, tril

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, warm
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.cholmod import require_cholmod
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze

from .columns import F64, Columns, columns_of
from .problems import Problem, load

_WAYS = (("simplicial", "amd"), ("supernodal", "amd"), ("auto", "default"))
Laps = dict[str, float]


def full_pass(job: dict[str, Any], problem: Problem, tell: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Milliseconds of both, medians of interleaved repetitions in thread CPU time."""
    warm()
    steps = load(problem)
    solver = Solver(Options(mode="all-batch", max_iterations=0))
    with np.load(job["values"]) as values:
        solver.stage(whole(steps, columns_of(steps), {kind: values[kind] for kind in values}))
    solver.step()
    ours, system = OurPass(solver), system_of(solver)
    information = system.sparse()
    lower = csc_matrix(tril(information))
    lower.sort_indices()
    eta = ours.eta
    passes: dict[str, Callable[[], tuple[Laps, F64]]] = {"ours": ours.run}
    for mode, ordering in _WAYS:
        passes[f"cholmod {mode} {ordering}"] = lambda m=mode, o=ordering: _cholmod(lower, eta, m, o)
    laps: dict[str, list[Laps]] = {name: [] for name in passes}
    solutions: dict[str, F64] = {}
    for repetition in range(job["repetitions"] + 1):  # the first one warms up and is not counted
        for name, run in passes.items():
            took, solutions[name] = run()
            if repetition:
                laps[name].append(took)
        tell({"done": repetition})
    found = {name: _medians(rows) for name, rows in laps.items()}
    best = min((name for name in found if name != "ours"), key=lambda name: found[name]["total"])
    return {
        "scalars": len(eta),
        "ms": found,
        "best": best,
        "ratio": float(np.median([b["total"] / a["total"] for a, b in zip(laps["ours"], laps[best], strict=True)])),
        "residual": {name: _residual(information, delta, eta) for name, delta in solutions.items()},
        "blas": cholmod_blas(),
    }


class OurPass:
    """The batch pass of our solver on one graph."""

    def __init__(self, solver: Solver) -> None:
        self._graph, self._blocks = graph_in(solver), system_in(solver).blocks
        self._dims = self._graph.dims[: self._graph.counts[at.COLUMNS]].copy()
        self._cholesky = Cholesky()
        # At the optimum η is 0 but for rounding; any other right-hand side tells more.
        self.eta = np.random.default_rng(1).normal(size=int(self._dims.sum()))

    def run(self) -> tuple[Laps, F64]:
        """(seconds by phase, δ)."""
        graph, blocks, dims, watch = self._graph, self._blocks, self._dims, _Watch()
        blocks.relinearize(graph, graph.values)
        watch.lap("linearize")
        perm = order(dims, blocks.rows, blocks.cols)
        watch.lap("order")
        symbolic = analyze(dims, blocks.rows, blocks.cols, perm)
        watch.lap("symbolic")
        if self._cholesky.factorize(symbolic, blocks.data, blocks.offsets) >= 0:
            raise RuntimeError("the final system is not positive definite")
        watch.lap("numeric")
        delta = self._cholesky.solve(self.eta)
        watch.lap("solve")
        return watch.done(), delta


def whole(steps: Sequence[Batch], columns: Columns, values: dict[str, F64]) -> Batch:
    """All steps as one batch, with `values` (by kind, in order of arrival)."""
    variables = []
    for kind, arrival in columns.arrival.items():
        is_fixed = np.isin(arrival, columns.fixed.get(kind, ()))
        for some, fixed in ((is_fixed, True), (~is_fixed, False)):
            if some.any():
                variables.append(Variables(kind, columns.keys[kind][arrival[some]], values[kind][some], fixed))
    groups: dict[str, list[Factors]] = {}
    for batch in steps:
        for group in batch.factors:
            groups.setdefault(group.kind, []).append(group)
    factors = [
        Factors(
            kind, *(np.concatenate([getattr(f, name) for f in found]) for name in ("keys", "measured", "information"))
        )
        for kind, found in groups.items()
    ]
    return Batch(tuple(variables), tuple(factors))


def system_of(solver: Solver) -> BlockSystem:
    """Λ as the solver holds it."""
    graph, blocks = graph_in(solver), system_in(solver).blocks
    dims = graph.dims[: graph.counts[at.COLUMNS]].copy()
    return BlockSystem(dims, blocks.rows.copy(), blocks.cols.copy(), blocks.data.copy(), blocks.offsets.copy())


def cholmod_blas() -> list[str]:
    """The BLAS libraries of CHOLMOD: those in this process that are not numpy's or scipy's own.  Raises NoBackend."""
    require_cholmod()
    paths = {row.split()[-1] for row in Path("/proc/self/maps").read_text().splitlines() if "blas" in row.lower()}
    return sorted(path for path in paths if "site-packages" not in path)


class _Watch:
    """Thread CPU seconds by phase."""

    def __init__(self) -> None:
        self._laps: Laps = {}
        self._start = self._last = time.thread_time()

    def lap(self, phase: str) -> None:
        now = time.thread_time()
        self._laps[phase], self._last = now - self._last, now

    def done(self) -> Laps:
        return {**self._laps, "total": self._last - self._start}


def _cholmod(lower: csc_matrix, eta: F64, mode: str, ordering: str) -> tuple[Laps, F64]:
    cholmod, watch = require_cholmod(), _Watch()
    factor = cholmod.analyze(lower, mode=mode, ordering_method=ordering)
    watch.lap("analyse")
    factor.cholesky_inplace(lower)
    watch.lap("numeric")
    delta = factor(eta)
    watch.lap("solve")
    return watch.done(), delta


def _residual(information: Any, delta: F64, eta: F64) -> float:
    """|Λδ − η| against |Λ| |δ|, which does not depend on the condition of Λ."""
    return float(np.abs(information @ delta - eta).max() / (np.abs(information.data).max() * np.abs(delta).max()))


def _medians(rows: Sequence[Laps]) -> Laps:
    return {name: 1e3 * float(np.median([row[name] for row in rows])) for name in rows[0]}
