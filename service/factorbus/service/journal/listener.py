"""Who hears what becomes of the writing of a journal."""

from collections.abc import Sequence
from typing import Protocol, TypeAlias

from factorbus.journal.problems import JournalFailed
from factorbus.service.core.events import Stepped, Verdict

Events: TypeAlias = Sequence[Verdict | Stepped]


class Listener(Protocol):
    """What is called with what becomes of the writing, on the journal's thread."""

    def kept(self, events: Events) -> None:
        """What came of an InsertBatch is safe."""
        ...

    def unkept(self, problem: JournalFailed) -> None:
        """What `kept` has not been called for did not happen; the solver goes back, and `reloaded` is to be called."""
        ...

    def blocked(self, problem: JournalFailed) -> None:
        """The disk takes nothing at the moment."""
        ...

    def unblocked(self) -> None:
        """It takes something again."""
        ...
