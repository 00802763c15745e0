"""What is handed to the thread of a journal."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from factorbus.journal.problems import JournalFailed
from factorbus.journal.records import Checkpoint
from factorbus.service.core.events import Arrived
from factorbus.service.journal.listener import Events


@dataclass(frozen=True, slots=True)
class HandedBatch:
    """Inserts that were applied together, or a further step, and what came of it."""

    number: int
    inserts: Sequence[Arrived]
    events: Events
    further: bool
    budget: float


@dataclass(frozen=True, slots=True)
class AfterWriting:
    """A call for when all before it is in the journal; `dropped` where it never will be."""

    call: Callable[[], None]
    dropped: Callable[[JournalFailed], None]


@dataclass(frozen=True, slots=True)
class NotedCheckpoint:
    """A checkpoint is written.  life: of the solver, which must not have gone back since."""

    saved: Checkpoint
    life: int


class SolverReloaded:
    """The solver is where the journal is."""
