"""What goes into the core and what comes out of it, as values.

An `Asker` waits for an answer: the shell's query, which the core carries about and never looks into.
Time is in seconds of any clock that does not go back; it arrives with the events.

Those on the path of every insert are named tuples: a frozen dataclass takes three times as long to make.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

from factorbus.proto.arrays import I64
from factorbus.proto.closures import ClosureEntry
from factorbus.proto.interest_codec import AskInterest
from factorbus.proto.messages import Insert
from factorbus.proto.problems import Problem, without_frames
from factorbus.service.questions.answers import Question

Asker: TypeAlias = Any


# ---- events -----------------------------------------------------------------------------------------------------


class ParsedInsert(NamedTuple):
    """The content of an insert that only adds, whose columns still lie in its message; `groups` says where
    (`kernels/read.py`).

    variables, factors: how many it has.
    """

    message: bytes
    groups: I64
    settle: bool = False
    convert_below: float = 0.0
    variables: int = 0
    factors: int = 0


class Arrived(NamedTuple):
    """An insert came in, and waits for its answer.

    askers: everybody who waits with it (a client may ask again).  content: the message, or the problem with it when
    only its sequence number could be read; such an insert takes its place in the sequence and is refused there; or
    verdicts of the map itself.
    digest tells a repetition from another message of that number.  message: the bytes as they came, for the journal.
    """

    askers: list[Asker]
    client: str
    sequence: int
    epoch: int
    size: int
    digest: int
    content: Insert | ParsedInsert | Problem | Any
    now: float
    message: bytes = b""

    @property
    def is_change(self) -> bool:
        """Whether it changes what the map has, which is a step of its own."""
        content = self.content
        return isinstance(content, ClosureEntry) or (isinstance(content, Insert) and bool(content.changes))


@dataclass(frozen=True, slots=True)
class ArrivedQuestion:
    """A question came in, with its bytes."""

    asker: Asker
    question: str
    payload: bytes


class Outcome(NamedTuple):
    """What became of one insert: the bytes of its Accepted, or why it was refused.

    first_factor: the id of its first factor; −1 where it was refused.
    """

    insert: Arrived
    answer: bytes | Any
    first_factor: int = -1


def refusal(insert: Arrived, problem: Exception) -> Outcome:
    """`insert` is refused, because of `problem`, which is remembered for when it is sent again."""
    return Outcome(insert, without_frames(problem))


class MovedClosure(NamedTuple):
    """A loop closure that is tested has another state, is new and not believed, or is gone; why."""

    factor: int
    state: str
    reason: str


class Verdict(NamedTuple):
    """The solver accepted or refused these inserts.

    revision, together: of the step that took in those that were accepted, and how many they were.  closures: whose
    state is another.
    """

    outcomes: tuple[Outcome, ...]
    revision: int = 0
    together: int = 0
    closures: tuple[MovedClosure, ...] = ()


class BudgetUse(NamedTuple):
    """What a step made of its budget, as its report says."""

    work: float = 0.0
    budget: float = 0.0
    deferred_relinearizations: int = 0
    unsolved: float = 0.0
    complete: bool = True


class Stepped(NamedTuple):
    """The solver made a step; the delta tells of it.

    converged, unfinished: if not, or if so, further steps are to follow when no insert does.  changed: how many
    variables; damping: what the next step would begin with.  further: without an insert, because the map was not at its
    optimum.  rebuilt: it brought back what had been accepted, in a new solver, after a fault.  step_ms: what a budget
    is for, of solver_ms; use: of its budget, None where it had none.  eliminated: how many variables, each time it was.
    """

    revision: int
    delta: bytes
    strategy: str
    chi2: float
    solver_ms: float
    rebuilt: bool = False
    converged: bool = True
    changed: int = 0
    damping: float = 0.0
    further: bool = False
    unfinished: bool = False
    step_ms: float = 0.0
    use: BudgetUse | None = None
    eliminated: int = 0


class Applied(NamedTuple):
    """The solver is done with an InsertBatch; how large the map is now, and what its thread has used.

    refused: a further step was, and the map is where it was.  closures: how many are in each state, where they are
    tested.
    """

    variables: int
    factors: int
    solver_cpu_s: float
    now: float
    refused: bool = False
    closures: Mapping[str, int] | None = None


class SingleInsertResult(NamedTuple):
    """One insert was applied in a step of its own: all that comes of it, at once."""

    outcome: Outcome
    stepped: Stepped
    applied: Applied


class Restored(NamedTuple):
    """How a map is that was here before.

    differs: why its journal, run again, may give other bits; empty: as far as is known it gives the same; None: it has
    none.  closures: as `Applied` has it.  complete: the last step left nothing for later ones.
    """

    revision: int
    variables: int
    factors: int
    chi2: float
    converged: bool = True
    unfinished: bool = False
    differs: str | None = None
    closures: Mapping[str, int] | None = None
    complete: bool = True


def reproducible_fields(differs: str | None) -> dict[str, Any]:
    """What the row of a map says of its journal."""
    if differs is None:
        return {}
    return {"reproducible": False, "reason": differs} if differs else {"reproducible": True}


# ---- what waits -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Read:
    """A question that needs the solver's state.  asker is None for a snapshot: its answer is published."""

    question: Question
    asker: Asker = None


# ---- effects ----------------------------------------------------------------------------------------------------


class Answer(NamedTuple):
    """Answer `asker` with these bytes."""

    asker: Asker
    message: bytes


@dataclass(frozen=True, slots=True)
class Tell:
    """Answer `asker` with a plain map, which the shell may add its own numbers to."""

    asker: Asker
    content: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Refuse:
    """Answer `asker` with a problem: anything with code, message and detail.

    following: of an insert, `detail.next`: above its number where that is used up; else what is wanted next.
    """

    asker: Asker
    problem: Any
    following: int | None = None


class Publish(NamedTuple):
    """Publish to everybody: channel is delta or event."""

    channel: str
    message: bytes


class InsertBatch(NamedTuple):
    """Work for the solver: first answer `reads` from the present revision, then apply `inserts`.

    short: most likely done sooner than another thread would have taken it over.  reload: first of all, go back to what
    the journal has.  further: there are no inserts, and one step is to go on from the last one.  budget: what each step
    may take, in units of the solver's work; 0: it has no bound.  keep: there are no inserts, and the map is to look for
    poses that it has enough of; the insert that takes them out is its own.  budget_ms: what the budget is of.
    """

    reads: tuple[Read, ...]
    inserts: tuple[Arrived, ...]
    short: bool = False
    reload: bool = False
    further: bool = False
    budget: float = 0.0
    keep: bool = False
    budget_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class Follow:
    """`asker` wants to follow a part of the estimate of the map that `row` describes, as admin/maps does."""

    asker: Asker
    ask: AskInterest
    row: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Drained:
    """Nothing is waiting any more and nothing will be taken: the map can be closed."""


Effect: TypeAlias = Answer | Tell | Refuse | Publish | InsertBatch | Follow | Drained
