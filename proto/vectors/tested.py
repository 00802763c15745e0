"""Golden messages of a map that tests its closures, §20: what it says of them, and how its verdicts are kept."""

import numpy as np

from factorbus.proto import codec
from factorbus.proto.closures import (
    AskSuspects,
    ClosureEntry,
    Suspects,
    encode_ask_suspects,
    encode_closure_entry,
    encode_suspects,
)
from factorbus.proto.messages import Batch, Change, Factors, Insert
from factorbus.proto.symbols import symbol

_EPOCH, _FALSE = 7, 3  # the factor that is false


def messages() -> dict[str, bytes]:
    """By name."""
    x = [symbol("x", n) for n in range(4)]
    omega = np.array([[16.0, 0, 0, 16, 0, 4]])
    edge = Factors("between_se2", np.array([[x[0], x[2]]]), np.array([[2.0, 0.5, 0.25]]), omega, trusted=True)
    judged = encode_closure_entry(
        ClosureEntry(
            1,
            np.array([_FALSE]),
            ("suspect",),
            ("improbable",),
            np.array([81.25]),
            np.array([0.0078125]),
            np.array([-1]),
        )
    )
    believed = encode_closure_entry(
        ClosureEntry(
            2, np.array([4]), ("accepted",), ("passed",), np.array([1.5]), np.array([0.015625]), np.array([-1]), True
        )
    )
    found = Suspects(
        _EPOCH, 4, "test", {"accepted": 0, "suspect": 1, "rejected": 0, "restored": 0}, np.array([_FALSE]),
        np.array([[x[0], x[3]]]), ("between_se2",), ("suspect",), ("improbable",), np.array([81.25]),
        np.array([0.0078125]), np.array([3]), np.array([3]),
    )  # fmt: skip
    graduated = encode_closure_entry(
        ClosureEntry(
            3, np.array([4]), ("suspect",), ("graduating",), np.array([2.5]), np.array([0.0625]), np.array([-1]),
            scale=np.array([5.5]),
        )
    )  # fmt: skip
    weighed = Suspects(
        _EPOCH, 4, "robust", {"accepted": 0, "suspect": 1, "rejected": 0, "restored": 0}, np.array([_FALSE]),
        np.array([[x[0], x[3]]]), ("between_se2",), ("suspect",), ("outweighed",), np.array([81.25]),
        np.array([0.9375]), np.array([3]), np.array([3]), np.array([0.0625]),
    )  # fmt: skip
    said = (Change("accept", np.array([4, 17])), Change("reject", np.array([_FALSE])))
    return {
        "admin_create_closures": codec.encode_map({"map": "kitchen", "mode": "auto", "closures": "test"}),
        "ask_suspects": encode_ask_suspects(AskSuspects()),
        "ask_suspects_all": encode_ask_suspects(AskSuspects(True)),
        "suspects": encode_suspects(found),
        "suspects_none": encode_suspects(Suspects(_EPOCH, 4, "trust")),
        "closure_entry": judged,
        "suspects_weighed": encode_suspects(weighed),
        "closure_entry_ahead": believed,
        "closure_entry_scales": graduated,
        "insert_overrides": codec.encode_insert(Insert(7, Batch(), epoch=_EPOCH, changes=said)),
        "insert_trusted": codec.encode_insert(Insert(8, Batch(factors=(edge,)), epoch=_EPOCH)),
        "event_closures": codec.encode_map(
            {"event": "closures", "epoch": _EPOCH, "revision": 4, "factors": [_FALSE], "states": ["suspect"],
             "reasons": ["improbable"]}
        ),
    }  # fmt: skip
