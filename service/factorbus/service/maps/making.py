"""What a map is made of: a core, a solver, and a journal where there are any; new, as it was, or as another one is."""

import secrets
import time
from collections.abc import Mapping
from typing import Any

from factorbus.proto.keep import keep_text
from factorbus.service.config import Config
from factorbus.service.core.budget import StepBudget
from factorbus.service.core.map_state import MapCore
from factorbus.service.core.removals import IdleRemovals
from factorbus.service.journal.library import (
    CopiedAt,
    Kept,
    Library,
    made_as_of,
    make_map_solver,
    own_options,
    restored,
)
from factorbus.service.maps.work_rate import WorkRate
from factorbus.service.questions.admin import Fork, MadeAs, settled
from factorbus.service.solving.apply import MapSolver


class MapMaker:
    """Makes what the maps of one service are made of.  On the control thread only."""

    def __init__(self, config: Config, library: Library | None) -> None:
        self._config, self._library, self._rate = config, library, WorkRate(config.warm)
        if config.budget_ms:
            self._rate.units_per_ms()  # before there is anybody who would wait for it

    def units_per_ms(self) -> float:
        """Units of work that a step does in a millisecond, as measured where the service starts."""
        return self._rate.units_per_ms()

    def begin(self, name: str, asked: MadeAs) -> tuple[MapCore, MapSolver, Kept | None]:
        """As it was, or new.  Raises Problem."""
        limits, library = self._config.limits, self._library
        if library is not None and library.has(name):
            kept = library.open(name, limits, asked)
        else:
            made_as = settled(asked, self._config.closures, self._config.budget_ms, keep_text(self._config.keep))
            if library is None:
                epoch, mode = secrets.randbits(62) | 1, made_as.mode or "auto"
                made = make_map_solver(mode, own_options(made_as), epoch, limits)
                return self._core(name, mode, epoch, made), made, None
            kept = library.make(name, made_as, limits)
        core = self._core(name, kept.header.mode, kept.header.epoch, kept.map_solver)
        kept.restore(core)
        return core, kept.map_solver, kept

    def fork(
        self, fork: Fork, was: MapCore, options: Mapping[str, Any], copied: CopiedAt
    ) -> tuple[MapCore, MapSolver, Kept | None]:
        """As the map of core `was`, which has these `options`, is in the copy.  Raises Problem."""
        limits, kept = self._config.limits, None
        if self._library is not None:
            kept = self._library.fork(fork.source, fork.target, copied, limits)
            epoch, map_solver = kept.header.epoch, kept.map_solver
        else:
            epoch = secrets.randbits(62) | 1
            map_solver = make_map_solver(was.mode, options, epoch, limits)
            map_solver.load(copied.state)
        core = self._core(fork.target, was.mode, epoch, map_solver)
        core.restore((), restored(map_solver, was.differs))
        return core, map_solver, kept

    def _core(self, name: str, mode: str, epoch: int, map_solver: MapSolver) -> MapCore:
        """Of a map with this solver."""
        made_as = made_as_of(mode, map_solver.options())
        budget = StepBudget(made_as.budget_ms, self._rate.units_per_ms()) if made_as.budget_ms else None
        removals = IdleRemovals(made_as.keep, here=not self._config.upstream)
        return MapCore(name, mode, epoch, self._config.limits, time.monotonic(), made_as.closures, budget, removals)
