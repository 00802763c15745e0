"""A map ordered anew beside the steps, where R has grown by how the map came together.  MATH §9.4.

    1  copy     when there are a quarter more loops than the last time; what each fold takes in from then on is noted
    2  order    on a thread of its own: another solver, in which all of the copy is eliminated in a fresh order
    3  compare  R of the map that was copied has `grown` times the numbers or more, or the other solver is let go
    4  follow   after each Run two of the folds that were noted, so that it catches up
    5  replace  when it has them all it takes the place of the first one, between two Runs

The journal has after which fold the copy was made and where it took the place, so a restart has the same bits.  Where
the solver is replaced otherwise (a change of the map, a fault), or both do not agree on what is to be refused, the
other one is let go.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from factorbus.service.core.events import Arrived, Judged, Run, Stepped
from factorbus.service.solving.apply import Folder
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

LEAST = 1000  # variables; what is smaller is eliminated quickly in any order,
_FEW = 0.02  # and so is what has fewer loops for each variable
_MORE = 1.25
_FOLLOW = 2
# As long as both are there a map takes three times what it takes by itself: arrays double when they grow.
_COPIES = 3


class _Noted(NamedTuple):
    """A fold: what the solver tried of it, and variables and factors after it.  further: a step without an insert."""

    inserts: Sequence[Arrived]
    size: tuple[int, int]
    further: bool


class Reordering:
    """What goes on beside one map.  `after` and `busy`: on the thread that has the Run.

    grown: from which share of fresh numbers on it is worth it; 0: never.  room: bytes that there are.
    """

    def __init__(self, folder: Folder, grown: float, room: Callable[[], int], name: str) -> None:
        self._folder, self._grown, self._room, self._name = folder, grown, room, name
        self._looked = 0  # loops at the last copy
        self._beside: _Beside | None = None

    @property
    def busy(self) -> bool:
        """Whether another solver is on its way, which no restart could make again from a snapshot taken now."""
        return self._beside is not None

    @property
    def waits(self) -> bool:
        """Whether it goes on with the end of the next Run, on whatever thread this is asked."""
        beside = self._beside
        return beside is not None and not beside.orders

    def after(self, run: Run, events: Sequence[Judged | Stepped], fold: int) -> Stepped | None:
        """`run` has ended; gives the step by which another solver took the place of the map's.

        fold: the number that the journal gives to what was folded.
        """
        beside = self._beside
        if beside is None:
            if self._is_due():
                self._beside = _Beside(self._folder, fold, self._grown, self._name)
            return None
        if run.inserts or run.further:
            beside.note(_tried(run.inserts, events), run.further)
        stays, taken = beside.go_on()
        if not stays:
            self._beside = None
        return taken

    def _is_due(self) -> bool:
        variables, factors = self._folder.size
        loops = factors - variables
        if not self._grown or variables < LEAST or not self._folder.nonzeros:
            return False
        if loops < max(_MORE * self._looked, _FEW * variables):
            return False
        self._looked = loops
        return _COPIES * self._folder.memory_bytes() <= self._room()


class _Beside:
    """One other solver, from the copy until it takes the place or is let go."""

    def __init__(self, folder: Folder, fold: int, grown: float, name: str) -> None:
        self._folder, self._fold, self._grown, self._name = folder, fold, grown, name
        self._solver, self._nonzeros = folder.solver, folder.nonzeros
        self._other: Folder | None = None  # once it is made, if it is worth it
        self._fresh = 0  # numbers of R where all of the copy is in a fresh order
        self._noted: deque[_Noted] = deque()
        content = folder.content()
        self._thread = threading.Thread(target=self._order, args=(content,), name=f"order {name}", daemon=True)
        self._thread.start()

    @property
    def orders(self) -> bool:
        """Whether the other solver is still being made."""
        return self._thread.is_alive()

    def note(self, inserts: Sequence[Arrived], further: bool) -> None:
        """These were folded in, or there were none and it was a further step."""
        self._noted.append(_Noted(inserts, self._folder.size, further))

    def go_on(self) -> tuple[bool, Stepped | None]:
        """(whether it goes on, the step by which it took the place)."""
        if self._folder.solver is not self._solver:
            return False, None
        if self.orders:
            return True, None
        other = self._other
        if other is None:
            return False, None
        for _ in range(min(_FOLLOW, len(self._noted))):
            if not self._follow(other, self._noted.popleft()):
                return False, None
        if self._noted:
            return True, None
        because = f"R had {self._nonzeros / self._fresh:.2f} times the numbers that it has in a fresh order"
        log.info("map %s: %s", self._name, because)
        return False, self._folder.take_place(other, self._fold, because)

    def _order(self, content: dict[str, Any]) -> None:
        try:
            other = self._folder.beside(content)
            self._fresh = other.nonzeros
            if self._nonzeros >= self._grown * self._fresh:
                self._other = other
        except (SolverError, MemoryError) as problem:
            log.warning("map %s is not ordered anew: %s", self._name, problem)
        except Exception:
            log.exception("map %s is not ordered anew", self._name)

    def _follow(self, other: Folder, noted: _Noted) -> bool:
        """Give `other` a fold; gives whether it is then as the map was, and by no way that a restart would not go."""
        events = list(other.fold_again(noted.inserts, further=noted.further))
        agrees = other.size == noted.size and not any(isinstance(e, Stepped) and e.rebuilt for e in events)
        if not agrees:
            log.info("map %s is not ordered anew: the other solver refused something else, or failed", self._name)
        return agrees


def _tried(inserts: Sequence[Arrived], events: Sequence[Judged | Stepped]) -> Sequence[Arrived]:
    """Those of `inserts` that the solver saw: what was refused before is not folded in by a restart either."""
    untried = {
        id(outcome.insert)
        for event in events
        if isinstance(event, Judged)
        for outcome in event.outcomes
        if not isinstance(outcome.answer, bytes | SolverError)
    }
    return [insert for insert in inserts if id(insert) not in untried]
