"""Golden messages of a map whose steps have a budget, §21: how it is made, how that is changed and taken away, what a
delta says, and its records;
and how one is made that keeps some poses, §22."""

import numpy as np

from factorbus.proto import codec
from factorbus.proto.keep import keep_text
from factorbus.proto.messages import Delta, Variables
from factorbus.proto.records import JournalPlace, RecordsPush, SentRecord, encode_records_push
from factorbus.proto.symbols import symbol

_EPOCH, _UNITS = 7, 1e9


def messages() -> dict[str, bytes]:
    """By name."""
    moved = Variables("se2", np.array([symbol("x", 9)]), np.array([[2.0, 0.5, 0.25]]))
    report = {
        "mode": "bayes-tree", "strategy": "tree", "converged": False, "converging": True, "chi2": 12.5, "step_ms": 9.5,
        "budget": _UNITS, "work": 987654321.0, "budget_ms": 10.0, "deferred_relinearizations": 250, "unsolved": 0.75,
        "complete": False,
    }  # fmt: skip
    place = JournalPlace(3, bytes(range(16)))
    records = (SentRecord(5, (), further=True, budget=_UNITS), SentRecord(6, (), further=True))
    return {
        "admin_create_budget": codec.encode_map({"map": "kitchen", "mode": "auto", "budget_ms": 10.0}),
        "admin_budget": codec.encode_map({"map": "kitchen", "budget_ms": 2.5}),
        "admin_budget_none": codec.encode_map({"map": "kitchen", "budget_ms": 0.0}),
        "admin_create_keep": codec.encode_map({"map": "town", "mode": "auto", "keep": keep_text("per_area=2")}),
        "delta_budget": codec.encode_delta(Delta(_EPOCH, 41, 40, (moved,), report)),
        "records_push_budget": encode_records_push(RecordsPush(place, records)),
    }
