"""Further steps of a map by its host: inserts go before, and a map that gets nowhere gives up."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from turned import closing, optimum
from unconverged import DEGREES, EPOCH, FEW, PATIENCE_S, POSES, arrived, inserts

from factorbus.proto import codec
from factorbus.service.config import Limits
from factorbus.service.core.converging import CONVERGE_IDLE_S
from factorbus.service.core.events import Answer, Applied, Drained, Effect, Publish
from factorbus.service.core.map_state import MapCore
from factorbus.service.maps.host import Host
from factorbus.service.solving.apply import GOES_ON, MapSolver
from factorbus.solver import Options, Solver


class Waiting(Solver):
    """A solver whose further steps say when they begin, and wait for leave."""

    def __init__(self) -> None:
        super().__init__(Options.of(mode="all-batch", **FEW))
        self.begun, self.leave = threading.Semaphore(0), threading.Semaphore(0)

    def step(self, settle: bool = False, budget: float | None = None) -> Any:
        if self.factor_count == POSES and not settle and self._stepper.mark == self._graph.mark():
            self.begun.release()
            assert self.leave.acquire(timeout=PATIENCE_S)
        return super().step(settle, budget)


class Told:
    """What a host had done."""

    def __init__(self) -> None:
        self.effects: list[Effect] = []
        self._more = threading.Condition()

    def take(self, effects: list[Effect]) -> None:
        with self._more:
            self.effects += effects
            self._more.notify_all()

    def take_both(self, asker: Any, answer: bytes, delta: bytes) -> None:
        self.take([Answer(asker, answer), Publish("delta", delta)])

    def wait_for(self, happened: Any) -> None:
        with self._more:
            assert self._more.wait_for(happened, PATIENCE_S)

    def answered(self) -> int:
        return sum(isinstance(effect, Answer) for effect in self.effects)

    def further(self) -> list[int]:
        """Where deltas of further steps are among all answers and deltas."""
        sent = [e for e in self.effects if isinstance(e, Answer) or (isinstance(e, Publish) and e.channel == "delta")]
        reports = [codec.decode_delta(e.message).report if isinstance(e, Publish) else {} for e in sent]
        return [n for n, report in enumerate(reports) if str(report.get("because")).startswith(GOES_ON)]


class Hosted:
    """A host of a map that has not converged."""

    def __init__(self, solver: Solver) -> None:
        self.told = Told()
        self.core = MapCore("m", "all-batch", EPOCH, Limits(step_inserts=1), 0.0)
        self.host = Host(
            self.core, MapSolver(lambda: solver, EPOCH, Limits()), self.told.take, self.told.take,
            lambda reads, taken: None, threading.Lock(), self.told.take_both,
        )  # fmt: skip
        self.came = inserts()
        for one in self.came:
            self.host.insert(one)
        self.told.wait_for(lambda: self.told.answered() == len(self.came))

    def tick_until(self, happened: Any) -> None:
        end = time.monotonic() + PATIENCE_S
        while not happened():
            self.host.tick()
            assert time.monotonic() < end

    def end(self) -> None:
        self.host.stop()
        self.told.wait_for(lambda: any(isinstance(effect, Drained) for effect in self.told.effects))
        self.host.end()


@pytest.fixture
def waiting() -> Iterator[tuple[Hosted, Waiting]]:
    solver = Waiting()
    hosted = Hosted(solver)
    yield hosted, solver
    solver.leave.release(10_000)
    hosted.end()


def test_an_insert_waits_for_the_further_step_under_way_and_no_other(waiting: tuple[Hosted, Waiting]) -> None:
    hosted, solver = waiting
    hosted.tick_until(lambda: solver.begun.acquire(blocking=False))
    answered = hosted.told.answered()
    hosted.host.insert(arrived(len(hosted.came) + 1, closing(POSES)))
    solver.leave.release()
    hosted.told.wait_for(lambda: hosted.told.answered() == answered + 1)
    assert len(hosted.told.further()) == 1
    assert not solver.begun.acquire(blocking=False), "no second one had begun"


def test_a_map_whose_steps_are_of_no_use_does_not_spin() -> None:
    steps: list[float] = []

    class Stuck(Solver):
        moves = True

        def step(self, settle: bool = False, budget: float | None = None) -> Any:
            report = super().step(settle, budget)
            self.moves = bool(report.new_factors or report.new_variables)
            if self.moves:
                return report._replace(converged=self.factor_count < POSES)
            steps.append(time.monotonic())
            return report._replace(converged=False, changed=0, damping=0.0)

        def pick_changed(self) -> Any:
            changed, graph = super().pick_changed()
            return changed if self.moves else changed[:0], graph

    hosted = Hosted(Stuck(Options(mode="all-batch")))
    try:
        hosted.tick_until(lambda: hosted.core.stats(0.0)["gave_up"])
        end = time.monotonic() + 20 * CONVERGE_IDLE_S
        hosted.tick_until(lambda: time.monotonic() > end)
        assert len(steps) == 3
        assert "3 further steps in a row changed nothing" in hosted.core.stats(0.0)["gave_up"]
        assert not hosted.core.row()["converging"]
    finally:
        hosted.end()


def test_a_map_that_comes_to_an_end_by_itself_is_what_it_says(waiting: tuple[Hosted, Waiting]) -> None:
    hosted, solver = waiting
    solver.leave.release(10_000)
    hosted.tick_until(lambda: not hosted.core.row()["converging"])
    assert hosted.core.row()["converged"]
    assert not any(isinstance(e, Applied) for e in hosted.told.effects)
    assert hosted.core.stats(0.0)["chi2"] == pytest.approx(optimum(POSES, DEGREES), rel=1e-6)
    assert np.isclose(solver.chi2(), hosted.core.stats(0.0)["chi2"], rtol=1e-12)
