"""What is written down, as values."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

# What became of an insert, and whether it goes to the solver when the journal is run again.
ACCEPTED = 0
REFUSED = 1  # by the solver, which may have tried: a step that failed leaves traces in how the next one is made
UNTRIED = 2  # refused before the solver saw it


class Entry(NamedTuple):
    """One insert, in its place.

    revision, first_factor, together: where it was accepted.  answer: the bytes it was answered with, an accepted or a
    problem, so that a client that asks again gets the same.  digest: of all the rest (`digest.sealed`).
    """

    client: str
    sequence: int
    digest: int
    outcome: int
    revision: int
    first_factor: int
    together: int
    answer: bytes
    message: bytes


class JournalRecord(NamedTuple):
    """Inserts that went to the solver together, in this order, and the revision that came of it.

    number: 1, 2, 3, ...   rebuilt: the solver failed meanwhile and was replaced   chain: a digest of every value that
    ever changed, up to here   further: a step without an insert, since the one before had not converged
    budget: what each of its steps might take, in units of the solver's work; 0: they had no bound
    """

    number: int
    revision: int
    rebuilt: bool
    chain: bytes
    entries: tuple[Entry, ...]
    further: bool = False
    budget: float = 0.0


class Maker(NamedTuple):
    """The build of the solver that made a record and those after it, up to the next maker's.

    build: its parts by name, as the solver names them.
    """

    record: int
    build: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Epoch:
    """One life of the map: its number, the record it begins with, and why it began."""

    epoch: int
    record: int
    because: str


@dataclass(frozen=True, slots=True)
class Header:
    """What a journal says of itself.  options: of the solver, which make the same steps of the same inserts."""

    map: str
    mode: str
    options: Mapping[str, Any]
    epochs: tuple[Epoch, ...]
    durability: str
    clean: bool

    @property
    def epoch(self) -> int:
        """The present one."""
        return self.epochs[-1].epoch


@dataclass(frozen=True, slots=True)
class Sender:
    """A client as a journal has left it: the number that is next, and its last entries, oldest first."""

    client: str
    next: int
    entries: tuple[Entry, ...] = field(default=())


class Checkpoint(NamedTuple):
    """A checkpoint that was written: after which record, in which format of a state, by which build, how large.

    differs: why a replay of the journal up to there may give other bits; empty: as far as is known it gives the same.
    """

    record: int
    format: int
    build: Mapping[str, str]
    differs: str = ""
    bytes: int = 0


class Last(NamedTuple):
    """Where a journal ends."""

    record: int
    revision: int
    chain: bytes
