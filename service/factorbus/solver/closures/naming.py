"""Why a factor that is named as a loop closure is none, or none that can be changed."""

from factorbus.solver.errors import SolverError
from factorbus.wording import counted


class NotAClosure(SolverError):
    """A factor that is no closure which the map tests."""

    code = "not_a_closure"

    def __init__(self, factor: int, count: int) -> None:
        have = f"it tests {counted(count, 'closure')}, which ask/suspects lists" if count else "it tests none so far"
        super().__init__(f"factor {factor} is no loop closure that the map tests: {have}", factor=factor)


class SwitchedOff(SolverError):
    """A change of a closure that is not in the estimate."""

    code = "switched_off"

    def __init__(self, change: str, factor: int, state: str) -> None:
        super().__init__(
            f"{change}: factor {factor} is a loop closure that the estimate does not have ({state}); accept it first, "
            "or remove it",
            factor=factor, state=state,
        )  # fmt: skip
