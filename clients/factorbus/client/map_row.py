"""A map as the service lists it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class MapRow:
    """A map as the service lists it.

    state: "open"; "blocked" while its journal cannot be written; anything else: it is on disk and does not open
    (`damaged`, `differs`, `other_version`, `unreadable`), and `problem` says why.  Of such a map there are no numbers.
    protocol: the names that its service knows (`changes`, `factors`, ...), as §13 of the contract has them; empty in a
    list of maps.  converged: its last step had; None: the service does not say.  converging: it takes further steps by
    itself, unless an insert comes.  reproducible: as far as is known, its journal gives the same estimate again to the
    bit; if not, `reason` says why; None: it has no journal, or the service does not say.  closures: "test" where loop
    closures are tested when they come.  budget_ms: what a step of it may take; 0: there is no bound.  complete: the
    last step left nothing for later ones.  keep: which poses stay of places that are driven through again and again, as
    `create` has it, with every number; "all": each.
    """

    name: str
    mode: str
    epoch: int
    revision: int
    variables: int
    factors: int
    state: str = "open"
    problem: str = ""
    protocol: Mapping[str, Any] = field(default_factory=dict)
    converged: bool | None = None
    converging: bool = False
    reproducible: bool | None = None
    reason: str = ""
    closures: str = "trust"
    budget_ms: float = 0.0
    complete: bool = True
    keep: str = "all"
