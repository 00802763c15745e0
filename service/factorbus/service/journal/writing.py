"""What is written down of an InsertBatch: its inserts in order, what became of each, a digest of what changed."""

from collections.abc import Sequence

from factorbus.journal import chain
from factorbus.journal.digest import sealed
from factorbus.journal.records import ACCEPTED, REFUSED, UNTRIED, Entry, JournalRecord
from factorbus.journal.store import Last
from factorbus.proto import codec
from factorbus.service.core.events import Arrived, Outcome, Stepped, Verdict
from factorbus.solver.errors import SolverError


def written(
    number: int, inserts: Sequence[Arrived], events: Sequence[Verdict | Stepped], last: Last, further: bool = False,
    budget: float = 0.0,
) -> JournalRecord:  # fmt: skip
    """What is written down of an InsertBatch.  further: it was for a further step, which may have been refused;
    budget: what each step of it might take."""
    present, revision, rebuilt = last.chain, last.revision, False
    outcomes: dict[int, tuple[Outcome, Verdict]] = {}
    for event in events:
        if isinstance(event, Verdict):
            outcomes |= {id(outcome.insert): (outcome, event) for outcome in event.outcomes}
            revision = max(revision, event.revision)
        else:
            present, revision = chain.extend_chain(present, event.delta), event.revision
            rebuilt = rebuilt or event.rebuilt
    entries = tuple(_entry(insert, *outcomes[id(insert)]) for insert in _with_judged(inserts, events))
    return JournalRecord(number, revision, rebuilt, present, entries, further and not rebuilt, budget)


def _with_judged(inserts: Sequence[Arrived], events: Sequence[Verdict | Stepped]) -> list[Arrived]:
    """The inserts, and behind each the verdicts on closures that it brought about: so they are applied again.

    Inserts that come from a journal have theirs among them.
    """
    given, behind, last = {id(insert) for insert in inserts}, dict[int, list[Arrived]](), 0
    for event in events:
        for outcome in event.outcomes if isinstance(event, Verdict) else ():
            if id(outcome.insert) in given:
                last = id(outcome.insert)
            else:
                behind.setdefault(last, []).append(outcome.insert)
    return [each for insert in inserts for each in (insert, *behind.get(id(insert), ()))]


def _entry(insert: Arrived, outcome: Outcome, verdict: Verdict) -> Entry:
    if isinstance(outcome.answer, bytes):
        answer = ACCEPTED, verdict.revision, outcome.first_factor, verdict.together, outcome.answer
    else:
        tried = REFUSED if isinstance(outcome.answer, SolverError) else UNTRIED
        answer = tried, verdict.revision, -1, 0, codec.encode_problem(outcome.answer)
    return sealed(Entry(insert.client, insert.sequence, 0, *answer, insert.message))
