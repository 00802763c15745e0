"""The journal of a map that begins as another one was: all that led there, the state there, and an epoch of its own."""

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from factorbus.journal.checkpoints import file_of, write_checkpoint
from factorbus.journal.folders import UNFINISHED, make_beside, sync_folder
from factorbus.journal.problems import JournalFailed
from factorbus.journal.records import Epoch
from factorbus.journal.store import NAME, Checkpoint, open_store

log = logging.getLogger(__name__)


def fork_journal(source: Path, target: Path, epoch: Epoch, state: Mapping[str, Any], saved: Checkpoint) -> None:
    """The journal in `source`, which may be at work, up to a record into `target`, which must not be there yet.

    state: of the solver after that record, so that a restart is quick; saved: which record that is, and what the state
    is of.  The inserts are there too.  All of it or nothing.
    Raises NoJournal, JournalDamaged, JournalVersion, JournalUnreadable, JournalFailed.
    """
    beside = target.with_name(f"{UNFINISHED}{target.name}")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        make_beside(beside)
        _copy(source, beside)
        _begin(beside, target.name, epoch, saved.record, _written(beside, state, saved))
        sync_folder(beside)
        beside.rename(target)
        sync_folder(target.parent)
    except OSError as error:
        raise JournalFailed(target / NAME, str(error)) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _copy(source: Path, beside: Path) -> None:
    store = open_store(source, read_only=True)
    try:
        store.copy_to(beside / NAME)
    finally:
        store.close()


def _written(beside: Path, state: Mapping[str, Any], saved: Checkpoint) -> Checkpoint | None:
    """The checkpoint, if there is room for it: without one a restart takes longer."""
    if not saved.record:
        return None
    path = file_of(beside, saved.record)
    try:
        return saved._replace(bytes=write_checkpoint(path, state))
    except OSError as error:
        log.warning("no checkpoint in %s: %s; a restart takes longer without it", path, error)
        return None


def _begin(beside: Path, name: str, epoch: Epoch, record: int, saved: Checkpoint | None) -> None:
    store = open_store(beside)
    try:
        store.become(name, record, epoch, saved)
    finally:
        store.close()
