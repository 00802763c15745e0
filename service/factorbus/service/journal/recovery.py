"""A map as its journal has it: from the newest good snapshot and what came after it, or from the very beginning.

Folded again in the same groups by the same build of the solver, the inserts give the same revisions to the bit; the
journal's digests of every fold tell whether they do.  A further step, of a map that had not converged, is made again,
too.

A snapshot counts in the format of a state that this version reads, whichever build wrote it: where another one rounds
otherwise, the map has what it had up to there, and the rest, folded again, is as good as it was and has other bits.
That is said, and is no reason to begin at the beginning.  See docs/decisions/state-format.md.
"""

import logging
from collections.abc import Iterator
from typing import NamedTuple

from factorbus.journal import chain
from factorbus.journal.problems import JournalDiffers
from factorbus.journal.records import ACCEPTED, REFUSED, UNTRIED, Entry, Fold, Sender
from factorbus.journal.snapshots import file_of, read_snapshot
from factorbus.journal.store import Last, Saved, Store
from factorbus.proto import codec
from factorbus.service.core.events import Arrived, Judged
from factorbus.service.solving.apply import Folder
from factorbus.service.solving.arrival import message_digest, read_again
from factorbus.solver.build import differences, present_build
from factorbus.solver.errors import SolverError
from factorbus.solver.state import FORMAT

log = logging.getLogger(__name__)


class Recovered(NamedTuple):
    """Where a folder is now.

    from_fold: the snapshot it began with, or 0.  folds, solver_s: what was folded again, and what its steps took.
    other_build: in what the build that made the map differs from this one; empty: in nothing.  same: no fold gave other
    bits than it had.  differs: why the journal, run again from its first insert, may give other bits; empty: as far as
    is known it gives the same.
    """

    last: Last
    from_fold: int = 0
    folds: int = 0
    solver_s: float = 0.0
    other_build: str = ""
    same: bool = True
    differs: str = ""


def recover(store: Store, folder: Folder) -> Recovered:
    """Bring `folder` to where the journal ends.  Raises JournalDamaged, JournalDiffers."""
    saved, whole = _from_snapshot(store, folder)
    begin = store.at(saved.fold) if saved else Last(0, 0, chain.START)
    history, (other, compared) = _History(store, folder), _other_builds(store, saved)
    last, folds, differs_from = begin, 0, 0
    for fold in store.folds(begin.fold):
        if history.again(fold, last.chain, bool(other)) != fold.chain and not differs_from:
            log.warning("%s: from revision %d on, values have other bits than they had", store.path, fold.revision)
            differs_from = fold.revision
        last, folds = Last(fold.number, fold.revision, fold.chain), folds + 1
    differs = _why_it_differs(saved, other, compared, differs_from)
    if not whole:
        differs = f"R was computed anew: snapshot {begin.fold} has it for vectors of another width ({other})"
    return Recovered(last, begin.fold, folds, history.solver_s, other, whole and not differs_from, differs)


def verify(store: Store, folder: Folder) -> Iterator[tuple[Fold, bool]]:
    """Fold everything again from the beginning; gives each fold, and whether it gave the same bits.

    Raises JournalDamaged, JournalDiffers.
    """
    folder.load(None)
    last, history, other = chain.START, _History(store, folder), bool(_other_builds(store, None)[0])
    for fold in store.folds():
        yield fold, history.again(fold, last, other) == fold.chain
        last = fold.chain


class _History:
    """What happened to a map, once more, to `folder`."""

    def __init__(self, store: Store, folder: Folder) -> None:
        self._store, self._folder = store, folder
        self.solver_s = 0.0

    def again(self, fold: Fold, before: bytes, other: bool) -> bytes:
        """Fold `fold` in again; gives the chain of digests after it.  Raises JournalDiffers.

        before: the chain as the journal has it, so that one fold with other bits does not hide whether the next ones
        have the same.  other: another build made the map, which a threshold may have taken another way: where
        that cost a step more or less, revisions are counted as the journal has them.
        """
        store, folder = self._store, self._folder
        present = self._fold(fold, before)
        if folder.revision != fold.revision:
            tried = fold.further or fold.rebuilt or any(entry.outcome != UNTRIED for entry in fold.entries)
            if not (other and tried):
                raise JournalDiffers(
                    store.path, f"fold {fold.number} led to revision {fold.revision}, and leads to {folder.revision}"
                )
            folder.count_from(fold.revision)
        return present

    def _fold(self, fold: Fold, present: bytes) -> bytes:
        inserts = [_arrived(entry) for entry in fold.entries if entry.outcome != UNTRIED]
        outcomes: dict[tuple[str, int], int] = {}
        for event in self._folder.fold_again(inserts, fold.rebuilt, fold.further):
            if isinstance(event, Judged):
                for outcome in event.outcomes:
                    done = ACCEPTED if isinstance(outcome.answer, bytes) else REFUSED
                    outcomes[outcome.insert.client, outcome.insert.sequence] = done
                    if not isinstance(outcome.answer, bytes):
                        log.debug("refused again: %s", outcome.answer)
            else:
                present = chain.follow(present, event.delta)
                self.solver_s += event.solver_ms * 1e-3
        for entry in fold.entries:
            if entry.outcome != UNTRIED and outcomes[entry.client, entry.sequence] != entry.outcome:
                was, now = ("accepted", "refused") if entry.outcome == ACCEPTED else ("refused", "accepted")
                raise JournalDiffers(
                    self._store.path, f"insert {entry.sequence} of client {entry.client} was {was}, and is {now}"
                )
        return present


def answers(sender: Sender) -> Iterator[tuple[int, int, object]]:
    """What a client was answered: (sequence, digest, answer), to the byte."""
    for entry in sender.entries:
        accepted = entry.outcome == ACCEPTED
        answer = entry.answer if accepted else codec.decode_problem(entry.answer)
        yield entry.sequence, message_digest(entry.message), answer


def _from_snapshot(store: Store, folder: Folder) -> tuple[Saved | None, bool]:
    """Begin with the newest snapshot that can be used, or with nothing; and whether `folder` has it to the bit."""
    for saved in store.snapshots():
        path = file_of(store.path.parent, saved.fold)
        if saved.format != FORMAT:
            log.warning("%s has a state of format %d, this version reads %d: not used", path, saved.format, FORMAT)
            continue
        try:
            return saved, folder.load(read_snapshot(path))
        except (OSError, ValueError, KeyError, TypeError, SolverError) as error:
            log.warning("%s cannot be used: %s", path, error)
    return None, folder.load(None)


def _other_builds(store: Store, saved: Saved | None) -> tuple[str, int]:
    """In what another build differs that made the snapshot or a fold after it, and how many folds such a one made."""
    here, begin, makers = present_build(), saved.fold if saved else 0, store.makers()
    found, count = differences(saved.build, here) if saved else "", 0
    ends = [*(maker.fold for maker in makers[1:]), store.last().fold + 1]
    for maker, end in zip(makers, ends, strict=True) if makers else ():
        folds, other = end - max(maker.fold, begin + 1), differences(maker.build, here)
        if folds > 0 and other:
            found, count = found or other, count + folds
    return found, count


def _why_it_differs(saved: Saved | None, other: str, compared: int, differs_from: int) -> str:
    """compared: folds of another build that were folded again."""
    if differs_from:
        why = f"another build made them ({other})" if other else "the same build made them"
        return f"from revision {differs_from} on, values have other bits than they had: {why}"
    if saved is None:
        return ""
    of_snapshot = differences(saved.build, present_build())
    if not saved.differs and of_snapshot and not compared:
        none = "no fold of it follows that could be compared"
        return f"another build wrote the snapshot of fold {saved.fold} ({of_snapshot}), and {none}"
    return saved.differs


def _arrived(entry: Entry) -> Arrived:
    digest, content = read_again(entry.message)
    return Arrived([], entry.client, entry.sequence, 0, len(entry.message), digest, content, 0.0, entry.message)
