"""What the rows must show, each as met or missed."""

from collections.abc import Callable, Sequence
from typing import Any

from bench.replays.targets import MET, MISSED, NOT_MEASURED, Verdict

from factorbus.service.core.converging import POLISH_IDLE_S

from .drives import WORLDS
from .rows import FAR, NEAR, together

UNCONVERGED, P99, FINISHED, TRUE, SAME = 0.01, 1.002, 1e-6, 1e-6, 1e-6
# From the last insert; a service begins when none has come for POLISH_IDLE_S, at its next tick.
FINISHED_S, TICK_S = 2.0, 0.25
SOLVER_S = FINISHED_S - POLISH_IDLE_S - TICK_S
_NAMED = 3  # worlds that miss a target, in its line

Row = dict[str, Any]


def judge(rows: Sequence[Row]) -> list[Verdict]:
    """`rows` are of drives; the shares and percentiles are of all drives of a world together."""
    worlds = {row["world"]: together([each for each in rows if each["world"] == row["world"]]) for row in rows}
    everything = list(worlds.values())
    ordinary = [row for row in everything if WORLDS[row["world"]].is_ordinary]
    return [
        _most(everything, f"a step that says `converged` is at most at {NEAR:g} x", "worst_converged", NEAR),
        _most(everything, f"a report's χ² is that of its estimate, to {TRUE:g} of it", "chi2_untrue", TRUE),
        _most(ordinary, f"ordinary drives: the 99th percentile of steps is at most at {P99:g} x", "p99", P99),
        _most(ordinary, f"ordinary drives: the worst step is at most at {FAR:g} x", "max", FAR),
        _check(
            ordinary,
            f"ordinary drives: at most {100 * UNCONVERGED:g} % of steps have not converged",
            lambda row: row["unconverged"] / row["steps"],
            UNCONVERGED,
        ),
        _check(
            everything,
            f"left alone, a map comes to its optimum, to {FINISHED:g}, and says so",
            lambda row: row["idle_ratio"] - 1 if row["idle_done"] else float("inf"),
            FINISHED,
        ),
        _most(everything, f"and within {FINISHED_S:g} s: the solver's, of a map left alone", "idle_s", SOLVER_S),
        _most(everything, f"SciPy finds the same optima, to {SAME:g}", "oracle_off", SAME),
    ]


def _most(rows: Sequence[Row], what: str, name: str, most: float) -> Verdict:
    return _check(rows, what, lambda row: row[name], most)


def _check(rows: Sequence[Row], what: str, number: Callable[[Row], float], most: float) -> Verdict:
    """Whether `number` is at most `most` in all rows; the worst of them are named."""
    if not rows:
        return Verdict(what, "", NOT_MEASURED)
    worst = sorted(((number(row), row["world"]) for row in rows), reverse=True)
    over = [each for each in worst if not each[0] <= most]
    named = over[:_NAMED] if over else worst[:1]
    seen = ", ".join(f"{value:.7g} {world}" for value, world in named)
    more = f" and {len(over) - _NAMED} more" if len(over) > _NAMED else ""
    return Verdict(what, seen + more, MISSED if over else MET)
