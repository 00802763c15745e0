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
    number: int, inserts: Sequence[Arrived], events: Sequence[Verdict | Stepped], last: Last, further: bool = False
) -> JournalRecord:
    """What is written down of an InsertBatch.  further: it was for a further step, which may have been refused."""
    present, revision, rebuilt = last.chain, last.revision, False
    outcomes: dict[int, tuple[Outcome, Verdict]] = {}
    for event in events:
        if isinstance(event, Verdict):
            outcomes |= {id(outcome.insert): (outcome, event) for outcome in event.outcomes}
            revision = max(revision, event.revision)
        else:
            present, revision = chain.extend_chain(present, event.delta), event.revision
            rebuilt = rebuilt or event.rebuilt
    entries = tuple(_entry(insert, *outcomes[id(insert)]) for insert in inserts)
    return JournalRecord(number, revision, rebuilt, present, entries, further and not rebuilt)


def _entry(insert: Arrived, outcome: Outcome, verdict: Verdict) -> Entry:
    if isinstance(outcome.answer, bytes):
        answer = ACCEPTED, verdict.revision, outcome.first_factor, verdict.together, outcome.answer
    else:
        tried = REFUSED if isinstance(outcome.answer, SolverError) else UNTRIED
        answer = tried, verdict.revision, -1, 0, codec.encode_problem(outcome.answer)
    return sealed(Entry(insert.client, insert.sequence, 0, *answer, insert.message))
