"""The folder of a service's journals: which maps are there, made, opened, and brought to where they were."""

import logging
import math
import os
import secrets
import shutil
import time
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from factorbus.journal.checkpoints import remove_strangers
from factorbus.journal.folders import GONE, is_map, left_behind, maps_in, sync_folder
from factorbus.journal.forking import fork_journal
from factorbus.journal.lock import Owned, own
from factorbus.journal.problems import JournalDamaged, JournalOption, NoJournal, NotWritten
from factorbus.journal.records import Epoch, Header, Maker
from factorbus.journal.store import NAME, Checkpoint, Last, Store, create, open_store
from factorbus.proto.budget import BUDGET_OPTION, BUDGET_SPAN_MS, BUDGET_WANTED
from factorbus.proto.closures import CLOSURE_POLICIES
from factorbus.proto.keep import KEEP_ALL, KEEP_OPTION, keep_text
from factorbus.proto.nearest import nearest
from factorbus.proto.problems import Problem
from factorbus.service.config import Config, Limits
from factorbus.service.core.map_state import MapCore, Restored
from factorbus.service.journal.checkpoint_plan import CheckpointPlan
from factorbus.service.journal.keeping import Keeper, Listener
from factorbus.service.journal.recovery import Recovered, answers, recover
from factorbus.service.questions.admin import MadeAs, check_made_as
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.robust import RobustMapSolver
from factorbus.service.solving.tested import TestedMapSolver
from factorbus.solver.build import present_build
from factorbus.solver.state import FORMAT

log = logging.getLogger(__name__)

_WHICHEVER = MadeAs()


def make_map_solver(mode: str, options: Mapping[str, Any], epoch: int, limits: Limits) -> MapSolver:
    """A map solver with a new solver in `mode`, and the other settings as `options` has them.  Raises JournalOption.

    closures: what becomes of loop closures, one of CLOSURE_POLICIES, is the map solver's own; by default they are
    trusted.  budget_ms: what its steps may take; by default they have no bound.  keep: which poses the map keeps; by
    default all.
    """
    from factorbus.solver import Options, Solver
    from factorbus.solver.errors import BadOption

    known, options = tuple(Options().as_dict()), dict(options)
    if (closures := options.pop("closures", "trust")) not in CLOSURE_POLICIES:
        raise JournalOption("closures", f"it is {closures!r:.40}; wanted one of {', '.join(CLOSURE_POLICIES)}")
    own = {}
    if (budget_ms := options.pop(BUDGET_OPTION, 0.0)) != 0.0:
        own[BUDGET_OPTION] = _checked_budget(budget_ms)
    if (keep := _checked_keep(options.pop(KEEP_OPTION, KEEP_ALL))) != KEEP_ALL:
        own[KEEP_OPTION] = keep
    for name in options:
        if name not in known:
            raise JournalOption(name, "there is no such option here" + nearest(name, known))
    try:
        settings = Options.of(**{**options, "mode": mode, "clock": time.perf_counter})
    except BadOption as bad:
        raise JournalOption(str(bad.detail["where"]), bad.message) from None
    if closures != "trust":
        own["closures"] = closures
        kind = RobustMapSolver if closures == "robust" else TestedMapSolver
        return kind(lambda: Solver(settings), epoch, limits, settings.as_dict() | own)
    return MapSolver(lambda: Solver(settings), epoch, limits, settings.as_dict() | own)


def own_options(made_as: MadeAs) -> dict[str, Any]:
    """The settings of a map that are not its solver's."""
    own = {"closures": made_as.closures or "trust", BUDGET_OPTION: made_as.budget_ms or 0.0}
    return own | {KEEP_OPTION: made_as.keep or KEEP_ALL}


def made_as_of(mode: str, options: Mapping[str, Any]) -> MadeAs:
    """How a map with these settings was made."""
    budget_ms, keep = float(options.get(BUDGET_OPTION, 0.0)), str(options.get(KEEP_OPTION, KEEP_ALL))
    return MadeAs(mode, str(options.get("closures", "trust")), budget_ms, keep)


def _checked_keep(keep: Any) -> str:
    """A journal's, in its one form.  Raises JournalOption."""
    try:
        return keep_text(str(keep))
    except Problem as bad:
        raise JournalOption(KEEP_OPTION, bad.message) from None


def _checked_budget(budget_ms: Any) -> float:
    """A journal's, if it is one.  Raises JournalOption."""
    if type(budget_ms) is not float or not BUDGET_SPAN_MS[0] < budget_ms <= BUDGET_SPAN_MS[1]:
        raise JournalOption(BUDGET_OPTION, f"it is {budget_ms!r:.40}; wanted {BUDGET_WANTED}")
    return budget_ms


def restored(map_solver: MapSolver, differs: str | None = None) -> Restored:
    """How the map in `map_solver` is.  differs: as `Restored` has it."""
    chi2 = map_solver.chi2() if map_solver.revision else 0.0
    done = map_solver.converged, map_solver.unfinished, differs
    return Restored(
        map_solver.revision, *map_solver.size, chi2, *done, map_solver.closure_counts(), map_solver.complete
    )


def log_owner(owner: str) -> None:
    """Say who is waited for."""
    log.info("standing by: the journal belongs to %s", owner or "a service that has not said who it is")


class CopiedAt(NamedTuple):
    """The state of a map after a record.  differs: why its journal may give other bits when it is run again."""

    record: int
    state: Mapping[str, Any]
    differs: str


class Library:
    """A folder of journals that this process owns."""

    def __init__(self, owned: Owned, config: Config) -> None:
        self._owned, self._config = owned, config
        for path in left_behind(owned.folder):
            shutil.rmtree(path, ignore_errors=True)

    def names(self, known: Container[str] = ()) -> list[str]:
        """The maps that there are, without those of the names `known`."""
        return maps_in(self._owned.folder, NAME, known)

    def disk(self) -> dict[str, int]:
        """Bytes of the disk that the folder is on: how many are free for this process, and how many there are."""
        seen = os.statvfs(self._owned.folder)
        return {"free_bytes": seen.f_bavail * seen.f_frsize, "size_bytes": seen.f_blocks * seen.f_frsize}

    def has(self, name: str) -> bool:
        """Whether there is a map of this name."""
        return is_map(self._owned.folder / name, NAME)

    def is_taken(self, name: str) -> bool:
        """Whether a new map cannot have this name: there is one, or a folder that is something else."""
        return (self._owned.folder / name).exists()

    def make(self, name: str, made_as: MadeAs, limits: Limits) -> "Kept":
        """A new map, and its journal.  Raises JournalFailed."""
        where, epoch, mode = self._owned.folder / name, secrets.randbits(62) | 1, made_as.mode or "auto"
        map_solver = make_map_solver(mode, own_options(made_as), epoch, limits)
        store = create(where, name, mode, map_solver.options(), epoch, self._config.durability)
        return Kept(store, store.header(), map_solver, Recovered(store.last()), self._config)

    def open(self, name: str, limits: Limits, asked: MadeAs = _WHICHEVER) -> "Kept":
        """The map `name` as it was, if it was made as it is asked for.

        Raises JournalDamaged, JournalDiffers, JournalVersion, JournalFailed; what `check_made_as` does.
        """
        path = self._owned.folder / name
        try:
            store = open_store(path, self._config.durability)
        except NoJournal:
            raise JournalDamaged(path, f"{NAME} is missing beside what was written with it") from None
        try:
            store.check_form()
            header = store.header()
            check_made_as(name, made_as_of(header.mode, header.options), asked)
            return _reopened(store, header, limits, self._config)
        except Problem:
            store.close()
            raise
        except Exception as fault:  # one map that nobody thought of keeps no other from coming back
            store.close()
            log.exception("%s: a fault while it was opened", path)
            raise JournalDamaged(path, f"opening it ends in {type(fault).__name__} ({fault})") from fault

    def fork(self, source: str, target: str, copied: CopiedAt, limits: Limits) -> "Kept":
        """A new map `target` with a journal, which is as `source` was when it was copied.  Raises Problem."""
        record, state = copied.record, copied.state
        where, config, because = self._owned.folder, self._config, f"forked from {source} after record {record}"
        epoch = Epoch(secrets.randbits(62) | 1, record + 1, because)
        fork_journal(
            where / source, where / target, epoch, state, Checkpoint(record, FORMAT, present_build(), copied.differs)
        )
        store = open_store(where / target, config.durability)
        try:
            header = store.header()
            map_solver = make_map_solver(header.mode, header.options, header.epoch, limits)
            map_solver.load(state)
            return Kept(store, header, map_solver, Recovered(store.last(), record, differs=copied.differs), config)
        except BaseException:
            store.close()
            self.remove(target)
            raise

    def remove(self, name: str) -> None:
        """Forget map `name`, which is closed: first its name, in one go, then its files.  Raises NotWritten."""
        path = self._owned.folder / name
        gone = self._owned.folder / f"{GONE}{name}-{secrets.token_hex(4)}"
        try:
            path.rename(gone)
            sync_folder(self._owned.folder)
            shutil.rmtree(gone)
        except OSError as error:
            raise NotWritten(path, str(error), "what is on disk of the map stays") from None

    def say(self, text: str) -> None:
        """Tell other processes that want the folder who has it."""
        self._owned.say(text)

    def close(self) -> None:
        """Let others own the folder."""
        self._owned.release()


class Kept:
    """A map with its journal, open: what a host and its core are to begin with."""

    def __init__(
        self, store: Store, header: Header, map_solver: MapSolver, recovered: Recovered, config: Config,
        epoch: Epoch | None = None,
    ) -> None:  # fmt: skip
        """epoch: a new one, which is not in the journal yet."""
        self.store, self.map_solver, self.recovered = store, map_solver, recovered
        self.header = replace(header, epochs=(*header.epochs, epoch)) if epoch else header
        self._config, self._epoch = config, epoch
        map_solver.enter(self.header.epoch)

    def restore(self, core: MapCore) -> None:
        """Tell `core` how the map is."""
        limits, epoch = self._config.limits, self.header.epochs[-1]
        senders = self.store.senders(epoch.record, limits.clients, limits.remembered)
        core.restore(
            [(sender.client, sender.next, answers(sender)) for sender in senders],
            restored(self.map_solver, self.recovered.differs),
        )

    def keeper(self, listener: Listener) -> Keeper:
        """As `keeping.Keeping`."""
        config, recovered = self._config, self.recovered
        # One that has other bits than those before is written as soon as may be: until then they cannot be had again.
        replayed_s = recovered.solver_s if recovered.same else math.inf
        plan = CheckpointPlan(config.checkpoint_s, replayed_s, recovered.differs)
        return Keeper(
            self.store, recovered.last, listener, config.durability, config.group_s, plan,
            lambda store: store.begin(config.durability, self._epoch, self._new_maker(store)),
        )  # fmt: skip

    def _new_maker(self, store: Store) -> Maker | None:
        """Who makes the next record, if it is not who made the last one."""
        here, makers = Maker(self.recovered.last.record + 1, present_build()), store.makers()
        return None if makers and makers[-1].build == here.build else here

    def reload(self, map_solver: MapSolver) -> Last:
        """As `keeping.Keeping`."""
        store = open_store(self.store.path.parent, read_only=True)
        try:
            return recover(store, map_solver).last
        finally:
            store.close()


def open_library(config: Config, waiting: Callable[[str], None], stop: Any) -> Library | None:
    """The library that `config` names, owned by this process; None if `stop` was set while standing by.

    Raises JournalInUse, UnsafeJournal, NotWritten.
    """
    folder = Path(config.journal)
    try:
        owned = own(folder, stop if config.standby else None, waiting)
    except OSError as error:
        raise NotWritten(folder, str(error), "the service does not start") from None
    return Library(owned, config) if owned is not None else None


def _reopened(store: Store, header: Header, limits: Limits, config: Config) -> Kept:
    started = time.perf_counter()
    map_solver = make_map_solver(header.mode, header.options, header.epoch, limits)
    recovered = recover(store, map_solver)
    if store.writable:
        remove_strangers(store.path.parent, {saved.record for saved in store.checkpoints()})
    epoch = None
    if because := _reason_for_an_epoch(header, recovered):
        epoch = Epoch(secrets.randbits(62) | 1, recovered.last.record + 1, because)
        log.warning("%s: a new epoch, because %s", store.path, because)
    log.info(
        "map %s is back at revision %d in %.2f s: checkpoint %d and %d records after it", header.map,
        recovered.last.revision, time.perf_counter() - started, recovered.from_record, recovered.records,
    )  # fmt: skip
    if recovered.other_build:
        log.warning("map %s was made by another build of the solver: %s", header.map, recovered.other_build)
    if recovered.differs:
        log.warning("map %s is not reproducible: %s", header.map, recovered.differs)
    return Kept(store, header, map_solver, recovered, config, epoch)


def _reason_for_an_epoch(header: Header, recovered: Recovered) -> str:
    """Clients must not go on from what is not there any more."""
    if header.durability != "commit" and not header.clean:
        return f"it was not closed in order, and durability {header.durability} does not keep what was answered last"
    return "" if recovered.same else "values have other bits than they had: another version or machine made them"
