"""The budget of a map's steps."""

from typing import Any

from factorbus.proto.problems import BadOption

# Of a map that is created, and of its journal's settings: milliseconds, from 0 (there is none) to a minute.
BUDGET_OPTION = "budget_ms"
BUDGET_SPAN_MS = (0.0, 60_000.0)
BUDGET_WANTED = "milliseconds from 0 (no bound) to 60000"


def checked_budget(budget_ms: Any) -> float:
    """`budget_ms` of a call; None: 0, which is none.  Raises BadOption."""
    if budget_ms is None:
        return 0.0
    is_number = isinstance(budget_ms, int | float) and not isinstance(budget_ms, bool)
    if not is_number or not BUDGET_SPAN_MS[0] <= budget_ms <= BUDGET_SPAN_MS[1]:
        raise BadOption(BUDGET_OPTION, f"is {budget_ms!r:.40}", BUDGET_WANTED)
    return float(budget_ms)
