"""Records of another journal put into a map's own: in their order, with what is here alone behind them.

    1  what the journal has after a place is compared with what is to come after it
    2  as far as both are the same nothing is done
    3  where the journal goes on otherwise, the map goes back to there, as after a restart: checkpoint and records
    4  the other's records are applied as they are: the same inserts together, the same further steps
    5  what is here alone follows, as it was together
    6  the journal is written in one transaction; until then nothing has happened

So both journals have the same records, and both maps the same values, to the bit.  On the solver's thread.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from factorbus.journal.digest import sealed
from factorbus.journal.records import ACCEPTED, REFUSED, UNTRIED, Entry, JournalRecord, Last
from factorbus.journal.rewriting import UpstreamPlace
from factorbus.journal.store import open_store
from factorbus.proto import codec
from factorbus.proto.messages import Insert
from factorbus.proto.own_clients import OWN_CLIENTS, count_inserts
from factorbus.proto.records import JournalPlace, SentInsert, SentRecord
from factorbus.service.core.events import MovedClosure, Stepped, Verdict
from factorbus.service.journal.keeping import Keeper
from factorbus.service.journal.record_problems import FactorsMoved, NumberTaken, RecordsDiffer, RecordsMovedOn
from factorbus.service.journal.recovery import arrived_again, recover
from factorbus.service.journal.writing import written
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import message_digest, read_again

log = logging.getLogger(__name__)

_FURTHER = SentRecord(0, (), further=True)


class Graft(NamedTuple):
    """Put `records` behind `after`.

    upstream_place: what the upstream has told of the last of them, of a replica; None: the records come from a
    replica, and are taken only where the journal ends at `after`.  heard: called with what came of it.
    """

    after: JournalPlace
    records: tuple[SentRecord, ...]
    upstream_place: JournalPlace | None = None
    heard: Callable[["Grafted"], None] = lambda _: None


class AnsweredInsert(NamedTuple):
    """An insert that is in the journal now, and what it is answered: bytes, or a problem."""

    client: str
    sequence: int
    digest: int
    answer: Any


class Grafted(NamedTuple):
    """What came of it.

    last: where the journal is.  steps: to be published.  rebased: records that were here alone and are made again.
    refused: inserts that had been accepted here, and why they are not any more.  same_outcomes: as they were told;
    same_bits: of a replica, the values are the upstream's.  behind: inserts that are here alone.  closures: whose state
    is another.
    """

    last: Last
    inserts: tuple[AnsweredInsert, ...] = ()
    steps: tuple[Stepped, ...] = ()
    rebased: int = 0
    refused: tuple[AnsweredInsert, ...] = ()
    same_outcomes: bool = True
    same_bits: bool = True
    behind: int = 0
    closures: tuple[MovedClosure, ...] = ()


def graft_records(
    name: str,
    graft: Graft,
    map_solver: MapSolver,
    keeper: Keeper,
    reload: Callable[[MapSolver], Last],
    check: Callable[[Iterable[tuple[str, int]]], None],
) -> Grafted:
    """Do what `graft` asks for.  reload: brings the map back to where the journal ends.  check: raises Problem where
    one of the inserts (client, number) of a replica is used up.

    Raises Problem: then nothing has changed.
    """
    keeper.settle()
    last, after = keeper.last, graft.after.record
    if graft.upstream_place is None:
        if (last.record, last.chain) != graft.after:
            raise RecordsMovedOn(name, last.record, after)
        if not graft.records:
            return Grafted(last)
        check((insert.client, insert.sequence) for record in graft.records for insert in record.inserts)
        return _kept(_Grafting(name, map_solver, last, False), graft, (), keeper, reload)
    store = open_store(keeper.folder, read_only=True)
    try:
        own = list(store.records(after)) if after < last.record else []
        here = sum(1 for _ in _alike(own, graft.records))
        if here == len(graft.records):
            ends = store.last_at(after + here) if after + here else Last(0, 0, bytes(16))
            place = UpstreamPlace(*graft.upstream_place)
            keeper.upstream = place
            behind = sum(count_inserts(record.entries) for record in own[here:])
            return Grafted(last, same_bits=ends.chain == place.chain, behind=behind)
        begin = last if here == len(own) else store.last_at(after + here) if after + here else Last(0, 0, bytes(16))
        if here < len(own):
            recover(store, map_solver, begin.record)
    finally:
        store.close()
    rest = graft._replace(records=graft.records[here:])
    return _kept(_Grafting(name, map_solver, begin, True, last.revision), rest, own[here:], keeper, reload)


def _alike(own: Iterable[JournalRecord], sent: Iterable[SentRecord]) -> Iterator[None]:
    """As many as are the same."""
    for mine, other in zip(own, sent, strict=False):
        if (mine.further, mine.rebuilt, mine.budget) != (other.further, other.rebuilt, other.budget):
            return
        if len(mine.entries) != len(other.inserts):
            return
        for entry, insert in zip(mine.entries, other.inserts, strict=True):
            if (entry.client, entry.sequence, entry.outcome) != (insert.client, insert.sequence, insert.outcome):
                return
            if message_digest(entry.message) != insert.digest:
                return
        yield


def _kept(
    at_work: "_Grafting",
    graft: Graft,
    own: Sequence[JournalRecord],
    keeper: Keeper,
    reload: Callable[[MapSolver], Last],
) -> Grafted:
    """Apply, and write down; what cannot be written did not happen."""
    try:
        at_work.take(graft.records)
        upstream_chain, taken = at_work.last.chain, len(at_work.records)
        if own:
            at_work.put_behind(own, graft.records)
        place = None if graft.upstream_place is None else UpstreamPlace(*graft.upstream_place)
        keeper.rewrite(at_work.begin, at_work.records, place)
    except BaseException:
        reload(at_work.map_solver)
        raise
    behind = sum(count_inserts(record.entries) for record in at_work.records[taken:])
    return at_work.grafted(bool(own))._replace(same_bits=place is None or place.chain == upstream_chain, behind=behind)


class _Grafting:
    """One graft at work.  published: the revision that was told last."""

    def __init__(self, name: str, map_solver: MapSolver, begin: Last, strict: bool, published: int = 0) -> None:
        self.map_solver, self.begin, self.last = map_solver, begin, begin
        self.records: list[JournalRecord] = []
        self._name, self._strict, self._published = name, strict, published
        self._steps: list[Stepped] = []
        self._refused: list[AnsweredInsert] = []
        self._moved: dict[int, MovedClosure] = {}
        self._same, self._rebased, self._before = True, 0, begin.revision

    def take(self, records: Iterable[SentRecord]) -> None:
        """The other's.  Raises RecordsDiffer where they come to another end, and must not."""
        for sent in records:
            made = self._apply(tuple(map(_entry_of, sent.inserts)), sent)
            for insert, entry in zip(sent.inserts, made.entries, strict=True):
                if (insert.outcome == ACCEPTED) != (entry.outcome == ACCEPTED):
                    self._same = False
                    if self._strict:
                        raise RecordsDiffer(self._name, insert.client, insert.sequence, made.number)
            if self._strict and made.revision != sent.revision:  # another build, which takes more steps or fewer
                self.map_solver.count_from(sent.revision)
                self.records[-1] = made._replace(revision=sent.revision)
                self.last = self.last._replace(revision=sent.revision)

    def put_behind(self, own: Sequence[JournalRecord], taken: Sequence[SentRecord]) -> None:
        """What is here alone."""
        there = {(insert.client, insert.sequence): insert.digest for sent in taken for insert in sent.inserts}
        ids = [entry.first_factor for record in own for entry in record.entries if entry.first_factor >= 0]
        first, moved = min(ids, default=0), False
        for record in own:
            # Verdicts on closures, and which poses are redundant, are of the map as it was: closures are judged with
            # the next insert, and poses are looked at when the map is idle.
            own_inserts = [entry for entry in record.entries if entry.client not in OWN_CLIENTS]
            entries = [entry for entry in own_inserts if not self._is_there(entry, there)]
            if not entries and not record.further:
                continue
            entries = [_again(entry, first if moved else None) for entry in entries]
            made = self._apply(tuple(entries), record)
            self._rebased += 1
            had = {(entry.client, entry.sequence): entry for entry in record.entries}
            for entry in made.entries:
                before = had[entry.client, entry.sequence]
                moved = moved or before.first_factor not in (-1, entry.first_factor)
                if before.outcome == ACCEPTED != entry.outcome:
                    self._refused.append(_answered(entry))
        # Who follows the map skips what is not newer than what it has.
        while self.map_solver.revision <= self._published and self.map_solver.size[0]:
            if self._apply((), _FURTHER).revision == self._before:
                break

    def grafted(self, rebased: bool) -> Grafted:
        """What came of it."""
        steps = tuple(self._steps)
        if rebased and steps:
            told = {"rebased": self._rebased, "rebased_refused": len(self._refused)}
            steps = (self.map_solver.whole_estimate(told),)
        inserts = tuple(_answered(entry) for record in self.records for entry in record.entries)
        refused, moved = tuple(self._refused), tuple(self._moved.values())
        return Grafted(self.last, inserts, steps, self._rebased, refused, self._same, closures=moved)

    def _is_there(self, entry: Entry, there: dict[tuple[str, int], int]) -> bool:
        digest = there.get((entry.client, entry.sequence))
        if digest is not None and digest != message_digest(entry.message):
            problem = NumberTaken(entry.client, entry.sequence)
            self._refused.append(AnsweredInsert(entry.client, entry.sequence, digest, problem))
        return digest is not None

    def _apply(self, entries: tuple[Entry, ...], like: JournalRecord | SentRecord) -> JournalRecord:
        """like: a record of another map, or of this one as it was, by the same steps."""
        self.map_solver.allow(like.budget)
        inserts = [arrived_again(entry) for entry in entries if entry.outcome != UNTRIED]
        events = list(self.map_solver.apply_again(inserts, like.rebuilt, like.further))
        made = written(self.last.record + 1, inserts, events, self.last, like.further, like.budget)
        tried = iter(made.entries)
        made = made._replace(entries=tuple(e if e.outcome == UNTRIED else next(tried) for e in entries))
        self._before = self.last.revision
        self.last = Last(made.number, made.revision, made.chain)
        self.records.append(made)
        self._steps += [event for event in events if isinstance(event, Stepped)]
        verdicts = [event for event in events if isinstance(event, Verdict)]
        self._moved |= {moved.factor: moved for verdict in verdicts for moved in verdict.closures}
        return made


def _again(entry: Entry, moved_from: int | None) -> Entry:
    """What is applied again was accepted: what was refused stays so.  moved_from: ids from there on are others'."""
    if entry.outcome == REFUSED:
        return sealed(entry._replace(outcome=UNTRIED))
    if entry.outcome == ACCEPTED and moved_from is not None:
        _, content = read_again(entry.message)
        named = [change.factors for change in content.changes] if isinstance(content, Insert) else []
        if any(ids is not None and (ids >= moved_from).any() for ids in named):
            problem = codec.encode_problem(FactorsMoved(moved_from))
            return sealed(entry._replace(outcome=UNTRIED, first_factor=-1, together=0, answer=problem))
    return entry


def _entry_of(insert: SentInsert) -> Entry:
    """As the journal has it, before it is applied."""
    return sealed(Entry(insert.client, insert.sequence, 0, insert.outcome, 0, -1, 0, insert.problem, insert.message))


def _answered(entry: Entry) -> AnsweredInsert:
    answer: Any = entry.answer if entry.outcome == ACCEPTED else codec.decode_problem(entry.answer)
    return AnsweredInsert(entry.client, entry.sequence, message_digest(entry.message), answer)


def sent_records(
    records: Iterable[JournalRecord], named: frozenset[int], most_bytes: int, most: int
) -> tuple[tuple[SentRecord, ...], Last | None, bool]:
    """The first of `records` as they are sent, up to `most` and some `most_bytes`; the last of them; are there more?

    named: digests of inserts that the receiver has.
    """
    sent: list[SentRecord] = []
    last, size = None, 0
    for record in records:
        if sent and (size >= most_bytes or len(sent) >= most):
            return tuple(sent), last, True
        inserts = tuple(_sent(entry, named) for entry in record.entries)
        sent.append(SentRecord(record.revision, inserts, record.further, record.rebuilt, record.budget))
        size += sum(len(insert.message) for insert in sent[-1].inserts)
        last = Last(record.number, record.revision, record.chain)
    return tuple(sent), last, False


def _sent(entry: Entry, named: frozenset[int]) -> SentInsert:
    digest = message_digest(entry.message)
    problem = b"" if entry.outcome == ACCEPTED else entry.answer
    message = b"" if digest in named else entry.message
    return SentInsert(entry.client, entry.sequence, message, digest, entry.outcome, problem)
