"""The report of a step: what was done, why, and how long each part took."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

_OF_A_BUDGET = ("deferred_relinearizations", "unsolved", "work", "budget", "complete")
_NONE: Mapping[str, float] = MappingProxyType({})


class StepReport(NamedTuple):
    """What one step did.

    mode         the solver's mode
    strategy     "extend": the gradient was zero, there was nothing to solve; "omega", "lambda", "full": how R was
                 brought up to date in the incremental modes (MATH §8); "all-batch": all was factorized, in that mode;
                 "tree", "batch": part of R was made again, or all was solved by Gauss-Newton, in the mode "bayes-tree"
    because      the reason for the strategy, for a person
    iterations   Gauss-Newton or Levenberg-Marquardt steps that were accepted
    chi2, chi2_before        Σ rᵀ Ω r of all factors at the published estimate; and at the values before the step, the
                 new factors included, new variables at their first values (`Options.initialize_locally`)
    new_variables, new_factors   added by this step
    changed      variables whose values differ from before, the new ones included
    relinearized linearization points that were moved, counted once per iteration
    eliminated   variables eliminated, counted once per factorization
    inactive       observations without a pixel, and so without weight, at the estimate (mode "bayes-tree": where it is
                 linearized); `Solver.inactive` says which and why
    nnz_r, flops of one factorization; damping: Levenberg-Marquardt's at the end (0: pure Gauss-Newton)
    converged    a full Gauss-Newton step from the estimate would not lower χ² by more than `Options.converged_share` of
                 it, in the mode "bayes-tree" by a bound; in the others the last iteration did not by more than the
                 tolerance
    phases_ms    milliseconds by phase;  step_ms: the whole step;  compiled_ms: the part of it within one compiled call,
                 where that does the work (mode "bayes-tree"), else None
    deferred_relinearizations, unsolved   of a step with a budget, else 0: variables that are due to be relinearized in
                 a later step; what χ² may be above the optimum: what `converged` goes by, and what was left behind
    work, budget what it took and what it might take, in the units of `Options.step_budget`; 0: it had no bound
    complete     nothing was left for later steps, neither to be relinearized nor by back-substitution
    """

    mode: str
    strategy: str
    because: str
    iterations: int = 0
    chi2: float = 0.0
    chi2_before: float = 0.0
    new_variables: int = 0
    new_factors: int = 0
    changed: int = 0
    relinearized: int = 0
    eliminated: int = 0
    inactive: int = 0
    nnz_r: int = 0
    flops: float = 0.0
    damping: float = 0.0
    converged: bool = True
    phases_ms: Mapping[str, float] = _NONE
    step_ms: float = 0.0
    compiled_ms: float | None = None
    deferred_relinearizations: int = 0
    unsolved: float = 0.0
    work: float = 0.0
    budget: float = 0.0
    complete: bool = True

    def as_dict(self) -> dict[str, Any]:
        """The same as plain types."""
        shown = self._asdict()
        phases = self.phases_ms
        shown["phases_ms"] = phases.as_dict() if isinstance(phases, PhaseShares) else dict(phases)
        if self.compiled_ms is None:
            del shown["compiled_ms"]
        if not self.budget:
            for name in _OF_A_BUDGET:
                del shown[name]
        return shown


class PhaseShares(Mapping[str, float]):
    """A total by name, in proportion to counts; worked out when somebody asks, since every step has one and few do."""

    __slots__ = ("_counts", "_names", "_total")

    def __init__(self, names: tuple[str, ...], counts: Sequence[int], total: float) -> None:
        self._names, self._counts, self._total = names, counts, total

    def __getitem__(self, name: str) -> float:
        if name not in self._names:
            raise KeyError(name)
        return self._total * self._counts[self._names.index(name)] / max(sum(self._counts), 1)

    def as_dict(self) -> dict[str, float]:
        """All of them, in a quarter of the time that asking for each takes."""
        total, count = self._total, max(sum(self._counts), 1)
        return {name: total * own / count for name, own in zip(self._names, self._counts, strict=False)}

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Stopwatch:
    """Adds up the time of named phases, one after the other, by the clock it is given."""

    def __init__(self, clock: Callable[[], float] | None) -> None:
        self._clock = clock
        self._start = self._last = clock() if clock else 0.0
        self.phases_ms: dict[str, float] = {}

    def lap(self, phase: str) -> None:
        """What passed since the last call was `phase`."""
        now = self._clock() if self._clock else 0.0
        self.phases_ms[phase] = self.phases_ms.get(phase, 0.0) + 1e3 * (now - self._last)
        self._last = now

    def total_ms(self) -> float:
        """Since it was made."""
        return 1e3 * ((self._clock() if self._clock else 0.0) - self._start)
