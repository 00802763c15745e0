"""A map as its journal has it: from the newest good snapshot and what came after it, or from the very beginning.

Folded again in the same groups by the same solver, the inserts give the same revisions to the bit; the chain of digests
proves it.  A snapshot counts only for the solver that wrote it (`fingerprint`): another one begins at the beginning.

A solver that was ordered anew beside the steps (`reordering.py`) is made again where it was, given the folds that it
was given, and takes the place where it did.  A further step, of a map that had not converged, is made again, too.
"""

import logging
from collections.abc import Iterator
from typing import NamedTuple

from factorbus.journal import chain
from factorbus.journal.problems import JournalDiffers
from factorbus.journal.records import ACCEPTED, REFUSED, UNTRIED, Entry, Fold, Sender
from factorbus.journal.snapshots import file_of, read_snapshot
from factorbus.journal.store import Last, Store
from factorbus.proto import codec
from factorbus.service.core.events import Arrived, Judged, Stepped
from factorbus.service.core.insert_digest import digest_of
from factorbus.service.solving.apply import Folder
from factorbus.service.solving.arrival import read_again

log = logging.getLogger(__name__)


class Recovered(NamedTuple):
    """Where a folder is now.  same: every value has the bits it had; from_fold: the snapshot it began with, or 0."""

    last: Last
    same: bool
    from_fold: int
    folds: int


def recover(store: Store, folder: Folder, fingerprint: str) -> Recovered:
    """Bring `folder` to where the journal ends.  Raises JournalDamaged, JournalDiffers."""
    begin = _from_snapshot(store, folder, fingerprint)
    last, same, folds = begin, True, 0
    history = _History(store, folder, begin.fold)
    for fold in store.folds(begin.fold):
        last = Last(fold.number, fold.revision, history.again(fold, last.chain))
        if same and last.chain != fold.chain:
            log.warning("%s: from revision %d on, values have other bits than they had", store.path, fold.revision)
            same = False
        folds += 1
    return Recovered(last, same, begin.fold, folds)


def verify(store: Store, folder: Folder) -> Iterator[tuple[Fold, bool]]:
    """Fold everything again from the beginning; gives each fold and whether all bits up to there are the same.

    Raises JournalDamaged, JournalDiffers.
    """
    folder.load(None)
    present, history = chain.START, _History(store, folder, 0)
    for fold in store.folds():
        present = history.again(fold, present)
        yield fold, present == fold.chain


class _History:
    """What happened to a map, once more, to `folder`."""

    def __init__(self, store: Store, folder: Folder, begin: int) -> None:
        """begin: the fold that `folder` is at."""
        self._store, self._folder = store, folder
        self._reordered = store.reordered(begin)
        self._beside: Folder | None = None

    def again(self, fold: Fold, present: bytes) -> bytes:
        """Fold `fold` in again; gives the chain of digests after it.  Raises JournalDiffers."""
        store, folder = self._store, self._folder
        if fold.reordered is not None:
            present = chain.follow(present, self._reorder(fold, fold.reordered).delta)
        else:
            present = self._fold(fold, present)
        if folder.revision != fold.revision:
            raise JournalDiffers(
                store.path, f"fold {fold.number} led to revision {fold.revision}, and leads to {folder.revision}"
            )
        if fold.number in self._reordered:
            self._beside = folder.beside(folder.content())
        return present

    def _reorder(self, fold: Fold, after: int) -> Stepped:
        if self._beside is None:
            raise JournalDiffers(
                self._store.path, f"fold {fold.number} was by a solver of fold {after}, which was not made again"
            )
        other, self._beside = self._beside, None
        return self._folder.take_place(other, after, "replayed")

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
        for entry in fold.entries:
            if entry.outcome != UNTRIED and outcomes[entry.client, entry.sequence] != entry.outcome:
                was, now = ("accepted", "refused") if entry.outcome == ACCEPTED else ("refused", "accepted")
                raise JournalDiffers(
                    self._store.path, f"insert {entry.sequence} of client {entry.client} was {was}, and is {now}"
                )
        if self._beside is not None:
            for _ in self._beside.fold_again(inserts, further=fold.further):
                pass
        return present


def answers(sender: Sender) -> Iterator[tuple[int, int, object]]:
    """What a client was answered: (sequence, digest, answer), to the byte."""
    for entry in sender.entries:
        accepted = entry.outcome == ACCEPTED
        yield entry.sequence, digest_of(entry.message), entry.answer if accepted else codec.decode_problem(entry.answer)


def _from_snapshot(store: Store, folder: Folder, fingerprint: str) -> Last:
    """Begin with the newest snapshot that can be used, or with nothing."""
    reordered = store.reordered()
    for saved in store.snapshots():
        path = file_of(store.path.parent, saved.fold)
        if any(made <= saved.fold < took for made, took in reordered.items()):
            continue  # the other solver cannot be made again from it
        if saved.fingerprint != fingerprint:
            log.info("%s is of another solver or machine: not used", path)
            continue
        try:
            folder.load(read_snapshot(path))
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.warning("%s cannot be used: %s", path, error)
            continue
        return store.at(saved.fold)
    folder.load(None)
    return Last(0, 0, chain.START)


def _arrived(entry: Entry) -> Arrived:
    digest, content = read_again(entry.message)
    return Arrived([], entry.client, entry.sequence, 0, len(entry.message), digest, content, 0.0, entry.message)
