"""What a question names and the map does not have."""

from collections.abc import Iterable

from factorbus.proto.problems import Problem
from factorbus.proto.symbols import format_symbol


class NotInMap(Problem):
    """A question about a variable that the map does not have."""

    code = "unknown_variable"

    def __init__(self, keys: Iterable[int]) -> None:
        missing = [int(key) for key in keys]
        names = ", ".join(map(format_symbol, missing[:5]))
        shown = names + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        super().__init__(
            f"the map has no {shown}; ask without keys for all there are", key=missing[0], keys=missing[:100]
        )


class NoPose(Problem):
    """A question about the last pose of a map that has none."""

    code = "unknown_variable"

    def __init__(self) -> None:
        super().__init__("the map has no pose yet: ask again when one is inserted")
