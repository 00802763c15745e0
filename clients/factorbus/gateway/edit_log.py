"""What has been edited in a map through this gateway: by whom, and how it is undone.  Kept while the gateway runs.

The journal of the service keeps the edits themselves, under the name of who made them.
"""

import asyncio
from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np

from factorbus.gateway.steps import EditStep, ids_of
from factorbus.proto.messages import Factors
from factorbus.proto.problems import Problem
from factorbus.proto.roles import pick_factors
from factorbus.proto.symbols import format_symbol

_REMEMBERED = 500  # edits; of older ones it is not known any more how they are undone


class NothingToUndo(Problem):
    """No edit is left to be undone, or it is not the last one."""

    code = "nothing_to_undo"


@dataclass(slots=True)
class Edit:
    """One that has been made.  back: what undoes it.  undone: by whom; empty: it stands."""

    number: int
    what: str
    who: str
    revision: int
    back: EditStep
    at: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    undone: str = ""

    def document(self) -> dict[str, Any]:
        """For a page."""
        return {name: getattr(self, name) for name in ("number", "what", "who", "revision", "at", "undone")}


class EditLog:
    """Of one map, from its creation to its end.  making: held while an edit is made, so that they follow each other."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch
        self.making = asyncio.Lock()
        self._edits: deque[Edit] = deque(maxlen=_REMEMBERED)
        self._count = 0
        self._called: dict[int, int] = {}  # of factors that came back: the id they had, and the next one
        self._rejected: dict[int, Factors] = {}  # by id, each alone
        self._brought: dict[int, int] = {}  # id of a factor that an edit brought, and the number of that edit

    def called(self, factor: int) -> int:
        """What a factor is called now that was called so."""
        while factor in self._called:
            factor = self._called[factor]
        return factor

    def rejected(self, factor: int) -> Factors | None:
        """A factor that was rejected and is not back; None: it is none."""
        return self._rejected.get(factor)

    def inserted(self, factor: int) -> dict[str, Any] | None:
        """The edit that brought a factor; None: none of these did."""
        number = self._brought.get(factor)
        return next((edit.document() for edit in self._edits if edit.number == number), None)

    def last(self, number: int) -> Edit:
        """The edit that is to be undone next, if it is this one.  Raises NothingToUndo."""
        standing = [edit for edit in self._edits if not edit.undone]
        if not standing:
            raise NothingToUndo("no edit is left that this gateway knows how to undo; nothing was changed")
        last = standing[-1]
        if last.number != number:
            raise NothingToUndo(
                f"edit {number} is not the last one: that is {last.number}, {last.what}, by {last.who}; undo that first"
            )
        return last

    def add(self, what: str, who: str, revision: int, back: EditStep, brought: list[int]) -> Edit:
        """An edit was made.  brought: the ids of all that it inserted."""
        self._count += 1
        edit = Edit(self._count, what, who, revision, back)
        self._edits.append(edit)
        self._brought.update(dict.fromkeys(brought, edit.number))
        return edit

    def made(self, step: EditStep, first_factor: int) -> list[int]:
        """`step` was made, and its factors are called from `first_factor` on; returns the ids of those that are new."""
        for group in step.reject:
            for n, each in enumerate(ids_of([group])):
                self._rejected[each] = pick_factors(group, np.arange(len(group.keys)) == n)
        new = list(range(first_factor, first_factor + step.insert.factor_count))
        for n, each in enumerate(ids_of(step.restore), first_factor + len(new)):
            del self._rejected[each]
            self._called[each] = n
        return new

    def document(self) -> dict[str, Any]:
        """{edits, undo, rejected} for a page: the last first; undo: the one that can be undone, or null."""
        listed = [edit.document() for edit in reversed(self._edits)]
        standing = [edit for edit in listed if not edit["undone"]]
        rejected = [
            {"id": each, "kind": group.kind, "keys": [format_symbol(key) for key in group.keys[0].tolist()]}
            for each, group in self._rejected.items()
        ]
        return {"edits": listed, "undo": standing[0] if standing else None, "rejected": rejected}
