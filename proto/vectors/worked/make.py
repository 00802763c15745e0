"""Write a worked example: one small map, and what a service answers to each question about it.

    factorbus serve                                                    (in another terminal)
    python proto/vectors/worked/make.py tcp/127.0.0.1:7447 [FOLDER]    (default: the folder of this file)

Four poses and two landmarks, whose factors do not agree: every number of every answer can be computed again from
`insert` and the equations, which a test does with dense matrices.  What differs from run to run is made the same:
epochs are 7, times 0.5, sizes of memory 1 MiB.  Written anew where a service answers more than it did; last bits
differ between machines.
"""

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh

from factorbus.proto import asking, codec, keys
from factorbus.proto import asking_codec as asked
from factorbus.proto import repair_codec as repairs
from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.proto.symbols import symbol

EPOCH, TIME, BYTES = 7, 0.5, 1 << 20
MAP, MARGINAL = "worked", "worked-marginal"
X, L = [symbol("x", i) for i in range(4)], [symbol("l", i) for i in (1, 2)]
POSE, POINT = [100.0, 0, 0, 100, 0, 400], [25.0, 5.0, 36.0]


def main() -> None:
    """Ask the service at ENDPOINT and write what it says."""
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent
    described = runpy.run_path(str(Path(__file__).parents[1] / "make.py"))["described"]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
    config.insert_json5("transport/shared_memory/enabled", "false")
    with zenoh.open(config) as session:
        for name, data in _exchange(session).items():
            (folder / f"{name}.msgpack").write_bytes(data)
            (folder / f"{name}.json").write_text(described(data))


def _exchange(session: zenoh.Session) -> dict[str, bytes]:
    deltas: list[bytes] = []
    subscriber = session.declare_subscriber(
        keys.delta_key(MAP), lambda sample: deltas.append(sample.payload.to_bytes())
    )
    told: dict[str, bytes] = {"admin_create": codec.encode_map({"map": MAP, "mode": "all-batch"})}
    told["row"] = _ask(session, keys.admin_key("create"), told["admin_create"])
    told["insert"] = codec.encode_insert(Insert(1, _batch(), settle=True, epoch=EPOCH))
    sent = codec.encode_insert(Insert(1, _batch(), settle=True))
    told["accepted"] = _ask(session, keys.insert_key(MAP, "robot1"), sent)
    more = Insert(2, _more(), settle=True, epoch=EPOCH)
    told["insert_more"] = codec.encode_insert(more)
    sent = codec.encode_insert(Insert(2, _more(), settle=True))
    told["accepted_more"] = _ask(session, keys.insert_key(MAP, "robot1"), sent)
    for name, (question, message) in _questions().items():
        if message != codec.encode_map({}):
            told[f"ask_{name}"] = message
        told[name] = _ask(session, keys.ask_key(MAP, question), message)
    told["admin_maps"] = _ask(session, keys.admin_key("maps"), b"")
    told["admin_stats"] = _ask(session, keys.admin_key("stats"), b"")
    _ask(session, keys.admin_key("fork"), codec.encode_map({"map": MAP, "as": MARGINAL}))
    # A landmark that three poses have seen goes: what it said of them stays, as one linear factor.
    third = Factors("landmark_se2", np.array([[X[3], L[0]]]), np.array([[-0.9, 1.1]]), np.array([POINT]))
    changes = (Change("marginalize", keys=np.array(L[:1])),)
    for sequence, insert in enumerate(
        (Insert(1, Batch(factors=(third,)), True), Insert(2, Batch(), changes=changes)), 1
    ):
        assert insert.sequence == sequence
        _ask(session, keys.insert_key(MARGINAL, "robot1"), codec.encode_insert(insert))
    told["graph_marginal"] = _ask(session, keys.ask_key(MARGINAL, "graph"), b"")
    told["covariances_marginal"] = _ask(session, keys.ask_key(MARGINAL, "covariance"), codec.encode_map({}))
    subscriber.undeclare()
    told["delta"], told["delta_more"] = deltas[:2]
    for name in (MARGINAL, MAP):
        _ask(session, keys.admin_key("drop"), codec.encode_map({"map": name}))
    return {name: bytes(msgpack.packb(_same(msgpack.unpackb(data))) or b"") for name, data in told.items()}


def _batch() -> Batch:
    values = np.array([[1.0, 0.1, 0.0], [2.1, 0.0, 0.1], [3.0, 0.3, 0.3]])
    variables = (
        Variables("se2", np.array(X[:1]), np.zeros((1, 3)), fixed=True),
        Variables("se2", np.array(X[1:]), values),
        Variables("point2", np.array(L), np.array([[2.0, 1.0], [3.0, 1.5]])),
    )
    steps = np.array([[1.0, 0.05, 0.0], [1.1, 0.0, 0.125], [0.9, 0.0, 0.125]])
    factors = (
        Factors("between_se2", np.array([X[:2], X[1:3], X[2:]]), steps, np.array([POSE] * 3)),
        Factors(
            "landmark_se2",
            np.array([[X[1], L[0]], [X[2], L[0]], [X[2], L[1]], [X[3], L[1]]]),
            np.array([[1.0, 0.9], [0.1, 1.0], [1.0, 1.4], [0.25, 1.1]]),
            np.array([POINT] * 4),
        ),
    )
    return Batch(variables, factors)


def _more() -> Batch:
    """A loop closure that is off, with a loss, and one that is far off, with another."""
    pairs, losses = ((X[0], X[3]), (X[1], X[3])), (("huber", 1.5), ("geman-mcclure", 3.0))
    measured = ([3.0, 0.5, 0.25], [2.5, 1.0, 0.5])
    return Batch(
        factors=tuple(
            Factors("between_se2", np.array([pair]), np.array([z]), np.array([POSE]), loss, np.array([scale]))
            for pair, z, (loss, scale) in zip(pairs, measured, losses, strict=True)
        )
    )


def _questions() -> dict[str, tuple[str, bytes]]:
    candidates = (
        Factors("between_se2", np.array([[X[0], X[2]], [X[0], X[3]]]), np.array([[2.1, 0.1, 0.1], [3.5, 1.5, 0.0]]),
                np.array([POSE] * 2)),
        Factors("landmark_se2", np.array([[X[1], L[1]]]), np.array([[2.0, 1.4]]), np.array([POINT])),
    )  # fmt: skip
    observations = np.array([[-0.9, 1.05], [0.2, 1.2], [5.0, 5.0]])
    seen = asking.AskAssociate(X[3], "landmark_se2", observations, np.array([POINT] * 3), None, 0.95)
    return {
        "estimate": ("estimate", codec.encode_keys_asked(None)),
        "chi2": ("chi2", codec.encode_map({})),
        "chi2_batch": ("chi2", codec.encode_map({"batch": True, "timeout_s": 60.0})),
        "graph": ("graph", codec.encode_map({})),
        "stats": ("stats", codec.encode_map({})),
        "export": ("export", codec.encode_map({"format": "tum"})),
        "covariances": ("covariance", asked.encode_ask_covariance(asking.AskCovariance())),
        "covariances_joint": (
            "covariance", asked.encode_ask_covariance(asking.AskCovariance("joint", np.array([X[2], L[1]])))
        ),
        "covariances_cross": (
            "covariance",
            asked.encode_ask_covariance(asking.AskCovariance("cross", np.array(X[1:3]), np.array([X[3], L[0]]))),
        ),
        "covariances_relative": (
            "covariance",
            asked.encode_ask_covariance(asking.AskCovariance("relative", np.array([[X[1], X[3]], [X[2], L[1]]]))),
        ),
        "gated": ("gate", asked.encode_ask_gate(asking.AskGate(candidates, 0.99))),
        "gained": ("gain", asked.encode_ask_gain(asking.AskGain(candidates))),
        "associated": ("associate", asked.encode_ask_associate(seen)),
        "why_factor": ("why", asked.encode_ask_why(asking.AskWhy(factor=1))),
        "why_variable": ("why", asked.encode_ask_why(asking.AskWhy(key=X[1]))),
        "repaired": ("repair", repairs.encode_ask_repair(asking.AskRepair(np.array([7, 8]), 0.99, values=True))),
    }  # fmt: skip


def _ask(session: zenoh.Session, key: str, message: bytes) -> bytes:
    for reply in session.get(key, payload=message, timeout=60.0, consolidation=zenoh.ConsolidationMode.NONE):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        raise SystemExit(f"{key}: {codec.decode_problem(reply.err.payload.to_bytes())}" if reply.err else key)
    raise SystemExit(f"{key}: nobody answers")


def _same(content: Any, name: str = "") -> Any:
    """What does not differ from run to run."""
    if isinstance(content, dict):
        return {key: _same(each, name if name == "silent_s" else key) for key, each in content.items()}
    if isinstance(content, list):
        return [_same(each) for each in content]
    fixed = {"epoch": EPOCH, "pid": 1, "service": "s1", "resident_bytes": BYTES, "limit_bytes": BYTES}
    if name in fixed:
        return fixed[name]
    return TIME if isinstance(content, float) and (name.endswith(("_s", "_ms")) or name == "seconds") else content


if __name__ == "__main__":
    main()
