"""Whatever is admitted, a map never holds a number that is not finite, and what would lead there is refused by name."""

import math
import random
import warnings
from collections import Counter
from typing import Any

import numpy as np
import pytest
from naive.random_extremes import MOST, Extremes

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.service.arrival import read_insert
from factorbus.service.config import Limits
from factorbus.service.events import Arrived, Judged, Stepped
from factorbus.service.fold import Folder
from factorbus.service.questions import Question
from factorbus.solver import Options, Solver

MODES = ("tree", "inc-l", "all-batch")
# What an insert within its bounds may be refused for.
REASONS = {"accepted", "diverged", "not_finite", "underconstrained", "uninitialised", "out_of_bounds", "bad_sight",
           "bad_direction", "not_positive_definite", "bad_range"}  # fmt: skip


class Map:
    """A map as the service has it, asked after every insert whether everything in it is a number."""

    def __init__(self, mode: str) -> None:
        self.folder = Folder(lambda: Solver(Options(mode=mode)), 9, Limits())
        self.values: dict[int, np.ndarray] = {}
        self.sequence = 0

    def insert(self, batch: Batch, changes: tuple[Change, ...] = (), settle: bool = False) -> str:
        """Code of the answer."""
        self.sequence += 1
        message = codec.encode_insert(Insert(self.sequence, batch, settle, changes=changes))
        arrived = read_insert(None, "a", message, REQUEST_LIMITS, 0.0)
        assert isinstance(arrived, Arrived), arrived
        events, _ = self.folder.fold_whole([arrived._replace(askers=[])])
        (answer,) = [o.answer for e in events if isinstance(e, Judged) for o in e.outcomes]
        for event in events:
            if isinstance(event, Stepped):
                self._follow(codec.decode_delta(event.delta))
        if isinstance(answer, bytes):
            return "accepted"
        return str(getattr(answer, "code", answer))

    def _follow(self, delta: codec.Delta) -> None:
        assert all(math.isfinite(number) for number in delta.report.values() if isinstance(number, float)), delta.report
        for group in delta.variables:
            assert group.values is not None
            assert (np.abs(group.values) <= MOST).all(), (group.kind, group.values)
            self.values |= dict(zip(group.keys.tolist(), group.values, strict=True))

    def estimate(self) -> dict[int, bytes]:
        taken = self.folder.snapshot([Question("estimate")])
        return {int(k): row.tobytes() for g in taken.variables for k, row in zip(g.keys, g.values, strict=True)}  # type: ignore[arg-type]


def fuzz(mode: str, seed: int, inserts: int) -> Counter[str]:
    """One map with so many inserts; how they were answered."""
    rng = np.random.default_rng(seed)
    world, tried, codes = Extremes(rng), Map(mode), Counter[str]()
    batch = world.begin()
    assert tried.insert(batch) == "accepted"
    world.accept(batch)
    for _ in range(inserts):
        batch, before = world.next(), dict(tried.values)
        code = tried.insert(batch, settle=bool(rng.random() < 0.2))
        codes[code] += 1
        assert code in REASONS, f"seed {seed}"
        assert math.isfinite(tried.folder.chi2()), f"seed {seed}"
        if code == "accepted":
            world.accept(batch)
        else:
            assert tried.values.keys() == before.keys()
    return codes


@pytest.mark.parametrize("mode", MODES)
def test_admissible_extremes_never_poison_a_map(mode: str, record_property: Any) -> None:
    first = random.randrange(2**32)
    print("seeds from", first)
    codes = Counter[str]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for seed in range(first, first + 60):
            codes += fuzz(mode, seed, 25)
    record_property("codes", dict(codes))
    assert codes["accepted"] > 100, codes
