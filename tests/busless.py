"""A map as the service has it, without a bus: what is inserted, how it is answered, and what its deltas tell."""

import math

import numpy as np
from naive.random_extremes import MOST

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Stepped, Verdict
from factorbus.service.questions.answers import Question
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import read_insert
from factorbus.solver import Options, Solver


class Map:
    """A map as the service has it, asked after every insert whether everything in it is a number."""

    def __init__(self, mode: str) -> None:
        self.map_solver = MapSolver(lambda: Solver(Options(mode=mode)), 9, Limits())
        self.values: dict[int, np.ndarray] = {}
        self.sequence = 0

    def insert(self, batch: Batch, changes: tuple[Change, ...] = (), settle: bool = False) -> str:
        """Code of the answer."""
        events, _ = self.map_solver.apply_whole([self.arrived(batch, changes, settle)])
        (answer,) = [o.answer for e in events if isinstance(e, Verdict) for o in e.outcomes]
        for event in events:
            if isinstance(event, Stepped):
                self._follow(codec.decode_delta(event.delta))
        if isinstance(answer, bytes):
            return "accepted"
        return str(getattr(answer, "code", answer))

    def arrived(self, batch: Batch, changes: tuple[Change, ...] = (), settle: bool = False) -> Arrived:
        """The next insert, as it comes from the bus."""
        self.sequence += 1
        message = codec.encode_insert(Insert(self.sequence, batch, settle, changes=changes))
        arrived = read_insert(None, "a", message, REQUEST_LIMITS, 0.0)
        assert isinstance(arrived, Arrived), arrived
        return arrived._replace(askers=[])

    def _follow(self, delta: codec.Delta) -> None:
        assert all(math.isfinite(number) for number in delta.report.values() if isinstance(number, float)), delta.report
        for group in delta.variables:
            assert group.values is not None
            assert (np.abs(group.values) <= MOST).all(), (group.kind, group.values)
            self.values |= dict(zip(group.keys.tolist(), group.values, strict=True))

    def estimate(self) -> dict[int, bytes]:
        taken = self.map_solver.snapshot([Question("estimate")])
        return {int(k): row.tobytes() for g in taken.variables for k, row in zip(g.keys, g.values, strict=True)}  # type: ignore[arg-type]
