"""A step's report of work, as it is in the answer to an insert and in a delta.  Explained in the contract, §4."""

import math
from typing import Any

# What each documented field is where a service does not tell it: nothing counted, nothing known.
_TEXTS = ("mode", "strategy", "because")
_COUNTS = (
    "closures", "suspects",
    "iterations", "new_variables", "new_factors", "changed", "relinearized", "eliminated", "nnz_r", "flops", "inactive",
    "points", "removed_variables", "removed_factors", "edited_factors", "fixed_variables", "freed_variables",
    "placed_variables", "added_factors", "deferred_relinearizations",
)  # fmt: skip
_NUMBERS = (
    "chi2",
    "chi2_before",
    "damping",
    "step_ms",
    "solver_ms",
    "compiled_ms",
    "unsolved",
    "work",
    "budget",
    "budget_ms",
)


class Report(dict[str, Any]):
    """A map that is open: fields of later services are in it, and asking for a documented one never fails.

    One that is not reported is "", 0, NaN, False or an empty map, by its type, and `complete` is True, since only a
    step with a budget leaves anything for later; `in` and `get` say whether it was.
    """

    def __missing__(self, name: str) -> Any:
        if name in _TEXTS:
            return ""
        if name in _COUNTS:
            return 0
        if name in _NUMBERS:
            return math.nan
        if name in ("converged", "converging"):
            return False
        if name == "complete":
            return True
        if name == "phases_ms":
            return {}
        raise KeyError(name)
