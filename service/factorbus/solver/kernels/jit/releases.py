"""The releases of Numba whose insides are changed while our kernels are compiled.  docs/decisions/private-numba.md.

With any other release Numba is used as it is: kernels give the same estimates, and compile and run slower.
FACTORBUS_STOCK_NUMBA=1 has it so with every release; 0 has it changed, as to try a release that is not in the list.
"""

import os
from importlib.metadata import version

__all__ = ["TESTED", "why_stock"]

# Those with which the solver's tests pass with our changes and without: `deploy/setup/try-numba.sh`.
TESTED = ("0.68.1",)

_VARIABLE = "FACTORBUS_STOCK_NUMBA"


def why_stock() -> str:
    """Why Numba is used as it is; empty where it is changed.  Raises ValueError: the variable is neither 0 nor 1."""
    value = os.environ.get(_VARIABLE, "")
    if value not in ("", "0", "1"):
        raise ValueError(
            f"{_VARIABLE} is {value!r}; wanted 1, for Numba as it is, or 0, for Numba changed: or unset it"
        )
    if value == "1":
        return f"{_VARIABLE} is 1"
    if not value and (installed := version("numba")) not in TESTED:
        return f"numba {installed} is not one of those tested ({', '.join(TESTED)})"
    return ""
