"""A map as its journal has it: from the newest good checkpoint and what came after it, or from the very beginning.

Applied again in the same groups by the same build of the solver, the inserts give the same revisions to the bit; the
journal's digests of every record tell whether they do.  A further step, of a map that had not converged, is made again,
too.

A checkpoint counts in the format of a state that this version reads, whichever build wrote it: where another one rounds
otherwise, the map has what it had up to there, and the rest, applied again, is as good as it was and has other bits.
That is said, and is no reason to begin at the beginning.  See docs/decisions/state-format.md.
"""

import logging
from collections.abc import Iterator
from itertools import takewhile
from typing import NamedTuple

from factorbus.journal import chain
from factorbus.journal.checkpoints import file_of, read_checkpoint
from factorbus.journal.problems import JournalDiffers
from factorbus.journal.records import ACCEPTED, REFUSED, UNTRIED, Entry, JournalRecord, Sender
from factorbus.journal.store import Checkpoint, Last, Store
from factorbus.proto import codec
from factorbus.proto.closures import decode_closure_entry
from factorbus.proto.own_clients import JUDGE
from factorbus.service.core.events import Arrived, Verdict
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import message_digest, read_again
from factorbus.service.solving.closure_entries import entry_again
from factorbus.solver.build import differences, present_build
from factorbus.solver.errors import Diverged, SolverError
from factorbus.solver.state import FORMAT

log = logging.getLogger(__name__)


class Recovered(NamedTuple):
    """Where a folder is now.

    from_record: the checkpoint it began with, or 0.  records, solver_s: those applied again, and what their steps took.
    other_build: in what the build that made the map differs from this one; empty: in nothing.  same: no record gave
    other bits than it had.  differs: why the journal, run again from its first insert, may give other bits; empty: as
    far as is known it gives the same.
    """

    last: Last
    from_record: int = 0
    records: int = 0
    solver_s: float = 0.0
    other_build: str = ""
    same: bool = True
    differs: str = ""


def recover(store: Store, map_solver: MapSolver, until: int = 1 << 62) -> Recovered:
    """Bring `map_solver` to where the journal ends, or to record `until`.  Raises JournalDamaged, JournalDiffers."""
    saved, whole = _from_checkpoint(store, map_solver, until)
    begin = store.last_at(saved.record) if saved else Last(0, 0, chain.START)
    history, (other, compared) = _History(store, map_solver), _other_builds(store, saved)
    last, records, differs_from = begin, 0, 0
    for record in takewhile(lambda record: record.number <= until, store.records(begin.record)):
        if history.again(record, last.chain, bool(other)) != record.chain and not differs_from:
            log.warning("%s: from revision %d on, values have other bits than they had", store.path, record.revision)
            differs_from = record.revision
        last, records = Last(record.number, record.revision, record.chain), records + 1
    differs = _why_it_differs(saved, other, compared, differs_from)
    if not whole:
        differs = f"R was computed anew: checkpoint {begin.record} has it for vectors of another width ({other})"
    return Recovered(last, begin.record, records, history.solver_s, other, whole and not differs_from, differs)


def verify(store: Store, map_solver: MapSolver) -> Iterator[tuple[JournalRecord, bool]]:
    """Replay everything from the beginning; gives each record, and whether it gave the same bits.

    Raises JournalDamaged, JournalDiffers.
    """
    map_solver.load(None)
    last, history, other = chain.START, _History(store, map_solver), bool(_other_builds(store, None)[0])
    for record in store.records():
        yield record, history.again(record, last, other) == record.chain
        last = record.chain


class _History:
    """What happened to a map, once more, to `map_solver`."""

    def __init__(self, store: Store, map_solver: MapSolver) -> None:
        self._store, self._map_solver = store, map_solver
        self.solver_s = 0.0

    def again(self, record: JournalRecord, before: bytes, other: bool) -> bytes:
        """Apply `record` again; gives the chain of digests after it.  Raises JournalDiffers.

        before: the chain as the journal has it, so that one record with other bits does not hide whether the next ones
        have the same.  other: another build made the map, which a threshold may have taken another way: where
        that cost a step more or less, revisions are counted as the journal has them.
        """
        store, map_solver = self._store, self._map_solver
        present = self._apply(record, before, other)
        if map_solver.revision != record.revision:
            tried = record.further or record.rebuilt or any(entry.outcome != UNTRIED for entry in record.entries)
            if not (other and tried):
                raise JournalDiffers(
                    store.path,
                    f"record {record.number} led to revision {record.revision}, and leads to {map_solver.revision}",
                )
            map_solver.count_from(record.revision)
        return present

    def _apply(self, record: JournalRecord, present: bytes, other: bool) -> bytes:
        entries = [entry for entry in record.entries if entry.outcome != UNTRIED and not (other and _diverged(entry))]
        inserts = [arrived_again(entry) for entry in entries]
        outcomes: dict[tuple[str, int], int] = {}
        self._map_solver.allow(record.budget)
        for event in self._map_solver.apply_again(inserts, record.rebuilt, record.further):
            if isinstance(event, Verdict):
                for outcome in event.outcomes:
                    done = ACCEPTED if isinstance(outcome.answer, bytes) else REFUSED
                    outcomes[outcome.insert.client, outcome.insert.sequence] = done
                    if not isinstance(outcome.answer, bytes):
                        log.debug("refused again: %s", outcome.answer)
            else:
                present = chain.extend_chain(present, event.delta)
                self.solver_s += event.solver_ms * 1e-3
        for entry in entries:
            if outcomes[entry.client, entry.sequence] != entry.outcome:
                was, now = ("accepted", "refused") if entry.outcome == ACCEPTED else ("refused", "accepted")
                raise JournalDiffers(
                    self._store.path, f"insert {entry.sequence} of client {entry.client} was {was}, and is {now}"
                )
        return present


def _diverged(entry: Entry) -> bool:
    """Whether it was refused since its step ran off, which one of another build need not do."""
    return entry.outcome == REFUSED and codec.decode_problem(entry.answer).code == Diverged.code


def answers(sender: Sender) -> Iterator[tuple[int, int, object]]:
    """What a client was answered: (sequence, digest, answer), to the byte."""
    for entry in sender.entries:
        accepted = entry.outcome == ACCEPTED
        answer = entry.answer if accepted else codec.decode_problem(entry.answer)
        yield entry.sequence, message_digest(entry.message), answer


def _from_checkpoint(store: Store, map_solver: MapSolver, until: int) -> tuple[Checkpoint | None, bool]:
    """Begin with the newest checkpoint that can be used, or nothing; and whether `map_solver` has it to the bit."""
    for saved in store.checkpoints():
        if saved.record > until:
            continue
        path = file_of(store.path.parent, saved.record)
        if saved.format != FORMAT:
            log.warning("%s has a state of format %d, this version reads %d: not used", path, saved.format, FORMAT)
            continue
        try:
            return saved, map_solver.load(read_checkpoint(path))
        except (OSError, ValueError, KeyError, TypeError, SolverError) as error:
            log.warning("%s cannot be used: %s", path, error)
    return None, map_solver.load(None)


def _other_builds(store: Store, saved: Checkpoint | None) -> tuple[str, int]:
    """In what another build differs that made the checkpoint or a record after it, and how many records it made."""
    here, begin, makers = present_build(), saved.record if saved else 0, store.makers()
    found, count = differences(saved.build, here) if saved else "", 0
    ends = [*(maker.record for maker in makers[1:]), store.last().record + 1]
    for maker, end in zip(makers, ends, strict=True) if makers else ():
        records, other = end - max(maker.record, begin + 1), differences(maker.build, here)
        if records > 0 and other:
            found, count = found or other, count + records
    return found, count


def _why_it_differs(saved: Checkpoint | None, other: str, compared: int, differs_from: int) -> str:
    """compared: records of another build that were applied again."""
    if differs_from:
        why = f"another build made them ({other})" if other else "the same build made them"
        return f"from revision {differs_from} on, values have other bits than they had: {why}"
    if saved is None:
        return ""
    of_checkpoint = differences(saved.build, present_build())
    if not saved.differs and of_checkpoint and not compared:
        none = "no record of it follows that could be compared"
        return f"another build wrote the checkpoint of record {saved.record} ({of_checkpoint}), and {none}"
    return saved.differs


def arrived_again(entry: Entry) -> Arrived:
    """An insert as it came, without anybody who waits for its answer."""
    if entry.client == JUDGE:
        return entry_again(entry.message, decode_closure_entry(entry.message))
    digest, content = read_again(entry.message)
    return Arrived([], entry.client, entry.sequence, 0, len(entry.message), digest, content, 0.0, entry.message)
