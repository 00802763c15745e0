"""Numbers outside their ranges, and values of wrong types, in every field of every message: a code, and never a fault.

The ranges are those of the contract, §12.
"""

from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from bare import Bare, bare, edge, keys_of, pose, start

from factorbus.proto import asking_codec, codec, features_codec, keys, repair_codec
from factorbus.proto.asking import AskAssociate, AskCovariance, AskGate, AskRepair, AskWhy
from factorbus.proto.camera import Camera
from factorbus.proto.features import Ask, Observations
from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.proto.problems import Refused

NAN, INF, TINY = float("nan"), float("inf"), 5e-324
ODD: list[Any] = [
    NAN, INF, -INF, -1, -1.0, 0, 0.0, TINY, 1e-300, 1e300, 2**63, -(2**63), "1", b"", b"\xff", [], [1], {}, None, True,
]  # fmt: skip
COLUMNS = {"keys", "values", "measured", "information", "scale", "weight", "factors", "ids", "others", "landmarks"}
COLUMNS |= {"state", "covariance", "pixels", "numbers"}


@pytest.fixture(scope="module")
def client(endpoint: str) -> Iterator[Bare]:
    with bare(endpoint) as opened:
        seen = Factors("landmark_se2", keys_of("x1", "l1")[None], np.array([[1.0, 1.0]]), np.array([[1.0, 0, 1.0]]))
        grounds = (start(), pose("x1", "x0"), pose("x2", "x1"), Batch((Variables("point2", keys_of("l1")),), (seen,)))
        for name in ("ranges", "changing"):
            opened.create(name)
            for sequence, batch in enumerate(grounds, 1):
                answer = opened.ask(keys.insert_key(name, "good"), codec.encode_insert(Insert(sequence, batch)))
                assert isinstance(answer, bytes), answer
        yield opened


def messages() -> dict[str, tuple[str, bytes]]:
    """Whole messages with every field that they may have: (key, bytes) by name."""
    x, l1, x2 = keys_of("x0", "x1"), keys_of("l1"), int(keys_of("x2")[0])
    soft = edge("x0", "x1")._replace(loss="huber", scale=np.ones(1), ids=np.zeros(1, np.int64))
    new = Variables("se2", keys_of("x7"), np.array([[1.0, 2.0, 0.1]]))
    changes = (
        Change("weigh", np.array([1]), weight=np.ones(1)),
        Change("loss", np.array([1]), loss="dcs", scale=np.ones(1)),
        Change("place", keys=x[1:], kind="se2", values=np.array([[1.0, 0, 0.1]])),
        Change("remove_variables", keys=l1, alone=True),
    )
    insert = Insert(1, Batch((new,), (soft,)), True, 0, 0.1, changes)
    camera = Camera("radtan", (500.0, 500, 320, 240, 0, 0, 0, 0), 640, 480)
    state = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], float)
    observations = Observations(camera, state, np.eye(13), np.array([[300.0, 200.0]]), 0.5, 0.2, 1.0)
    seen = AskAssociate(int(x[1]), "landmark_se2", np.ones((1, 2)), np.array([[1.0, 0, 1.0]]), l1, 0.9)
    asked = {
        "estimate": codec.encode_keys_asked(x),
        "chi2": codec.encode_map({"batch": False, "timeout_s": 5.0}),
        "export": codec.encode_map({"format": "g2o"}),
        "gate": asking_codec.encode_ask_gate(AskGate((soft,), 0.9)),
        "associate": asking_codec.encode_ask_associate(seen),
        "repair": repair_codec.encode_ask_repair(AskRepair(np.array([1]), 0.9, True)),
        "covariance": asking_codec.encode_ask_covariance(AskCovariance("cross", x, l1)),
    }
    made = {f"ask/{name}": (keys.ask_key("ranges", name), payload) for name, payload in asked.items()}
    made["ask/why key"] = keys.ask_key("ranges", "why"), asking_codec.encode_ask_why(AskWhy(key=x2))
    made["ask/why factor"] = keys.ask_key("ranges", "why"), asking_codec.encode_ask_why(AskWhy(factor=1))
    made["insert"] = keys.insert_key("changing", "CLIENT"), codec.encode_insert(insert)
    made["create"] = keys.admin_key("create"), codec.encode_map({"map": "ranges", "mode": "auto"})
    made["drop"] = keys.admin_key("drop"), codec.encode_map({"map": "nowhere", "revision": 999})
    made["fork"] = keys.admin_key("fork"), codec.encode_map({"map": "ranges", "as": "ranges", "request": 1})
    made["budget"] = keys.admin_key("budget"), codec.encode_map({"map": "ranges", "budget_ms": 5.0})
    made["features"] = "FEATURES", features_codec.encode_ask(Ask(observations))
    return made


def places(content: Any, before: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path to every value in a message."""
    for name in content if isinstance(content, dict) else range(len(content)):
        path = (*before, name)
        yield path
        if isinstance(content[name], dict | list):
            yield from places(content[name], path)


def changed(content: Any, path: tuple[Any, ...], value: Any) -> bytes:
    """The message with another value there; in a column, with a number of it changed."""
    copy = msgpack.unpackb(msgpack.packb(content))
    at = copy
    for name in path[:-1]:
        at = at[name]
    at[path[-1]] = value
    return msgpack.packb(copy)


def in_column(column: bytes, value: float) -> bytes:
    numbers = np.frombuffer(column, "<f8").copy()
    numbers[-1] = value
    return numbers.tobytes()


@pytest.mark.parametrize("name", messages())
def test_whatever_a_field_holds_the_answer_is_one_of_the_contract(client: Bare, endpoint: str, name: str) -> None:
    key, payload = messages()[name]
    if key == "FEATURES":
        key = keys.features_key(codec.decode_map(client.ask(keys.admin_key("maps")))["service"])  # type: ignore[arg-type]
    content, count = msgpack.unpackb(payload), 0
    for path in places(content):
        values = list(ODD)
        value = content
        for step in path:
            value = value[step]
        if path[-1] in COLUMNS and isinstance(value, bytes) and value:
            values += [in_column(value, each) for each in (NAN, INF, -1.0, 0.0, TINY, 1e300)] + [value[:-1], value * 2]
        for value in values:
            count += 1
            to = key.replace("CLIENT", f"c{count}")
            came = client.ask(to, changed(content, path, value))
            assert came is not None, f"{path} {value!r}: silence"
            if isinstance(came, Refused):
                told = f"{path} {value!r:.60}: {came}, {came.detail}"
                assert came.code != "internal", told
                if came.code in ("bad_message", "bad_option", "bad_loss", "bad_weight", "not_finite", "bad_state"):
                    assert {"where", "seen", "wanted"} <= set(came.detail), told
                if "/in/" in to:
                    assert came.detail["next"] in (1, 2), told
                    assert came.detail["next"] == (1 if path == ("sequence",) or came.code == "wrong_epoch" else 2), (
                        told
                    )
    assert client.stats("ranges")["name"] == "ranges"


EDGE = codec.encode_insert(Insert(1, Batch((), (edge("x0", "x1"),))))
LOSS = {"change": "loss", "factors": bytes(8), "scale": np.ones(1).tobytes()}
OUTSIDE: list[tuple[str, str, Any, str, str]] = [
    ("insert", "sequence", 0, "bad_message", "sequence"),
    ("insert", "sequence", -1, "bad_message", "sequence"),
    ("insert", "sequence", 2**63, "bad_message", "sequence"),
    ("insert", "epoch", -1, "bad_message", "epoch"),
    ("insert", "epoch", 2**63, "bad_message", "epoch"),
    *[("insert", "convert_below", bad, "bad_option", "insert.convert_below") for bad in (NAN, INF, -1, -TINY)],
    *[("ask/gate", "probability", p, "bad_option", "question.probability") for p in (0, 1, -1, NAN, INF, 1e-300, TINY)],
    *[("ask/repair", "probability", p, "bad_option", "question.probability") for p in (0, 1.0, NAN, 1e-300, TINY)],
    *[("ask/associate", "probability", p, "bad_option", "question.probability") for p in (0.0, 1, 1e300, -INF, TINY)],
    *[("ask/chi2", "timeout_s", s, "bad_option", "question.timeout_s") for s in (0, -1.0, NAN, INF, 1e300, TINY)],
    ("ask/chi2", "timeout_s", 2**63, "bad_message", "question.timeout_s"),
    ("ask/chi2", "batch", 1, "bad_message", "question.batch"),
    ("ask/export", "format", "csv", "bad_option", "question.format"),
    ("ask/export", "format", 1, "bad_message", "question.format"),
    ("ask/covariance", "blocks", "x", "bad_option", "question.blocks"),
    ("ask/why key", "key", 2**63, "bad_message", "question.key"),
    ("ask/why key", "factor", 1, "bad_message", "question"),
    ("create", "mode", "x", "bad_option", "create.mode"),
    *[("create", word, "", "bad_option", f"create.{word}") for word in ("mode", "closures", "keep")],
    ("ask/covariance", "blocks", "", "bad_option", "question.blocks"),
    ("ask/export", "ids", "", "bad_option", "question.ids"),
    ("insert", "changes", [LOSS | {"loss": ""}], "bad_loss", "changes[0].loss"),
    ("insert", "changes", [LOSS | {"loss": "soft"}], "bad_loss", "changes[0].loss"),
    ("drop", "revision", -1, "bad_message", "drop.revision"),
    *[("budget", "budget_ms", bad, "bad_option", "budget.budget_ms") for bad in (NAN, INF, -1, -TINY, 60_000.1)],
    ("budget", "budget_ms", None, "bad_message", "budget.budget_ms"),
    ("fork", "request", 2**63, "bad_message", "fork.request"),
]


@pytest.mark.parametrize(("name", "field", "value", "code", "where"), OUTSIDE)
def test_a_number_or_word_that_is_not_taken(
    client: Bare, name: str, field: str, value: Any, code: str, where: str
) -> None:
    key, payload = messages()[name]
    content = msgpack.unpackb(payload) | {field: value}
    came = client.ask(key.replace("CLIENT", f"out-{abs(hash((field, repr(value))))}"), msgpack.packb(content))
    assert isinstance(came, Refused), came
    assert (came.code, came.detail["where"]) == (code, where)
    assert came.detail["seen"] in came.message
    assert came.detail["wanted"] in came.message


@pytest.mark.parametrize("key", [-1, -(2**63), 2**63 - 1])
def test_any_int64_may_be_a_key(client: Bare, key: int) -> None:
    """Nothing is wrong with it but that the map has no such variable, and the detail has the same form everywhere."""
    no_such = np.array([key])
    row, information = np.ones((1, 2)), np.array([[1.0, 0, 1.0]])
    asked = {
        "why": asking_codec.encode_ask_why(AskWhy(key=key)),
        "associate": asking_codec.encode_ask_associate(AskAssociate(key, "landmark_se2", row, information)),
        "estimate": codec.encode_keys_asked(no_such),
        "covariance": asking_codec.encode_ask_covariance(AskCovariance("joint", no_such)),
    }
    came = [client.ask(keys.ask_key("ranges", name), payload) for name, payload in asked.items()]
    ends = np.array([[int(keys_of("x0")[0]), key]])
    broken = Batch((), (edge("x0", "x1")._replace(keys=ends),))
    for n, insert in enumerate((Insert(1, broken), Insert(1, Batch(), changes=(Change("fix", keys=no_such),)))):
        came.append(client.ask(keys.insert_key("ranges", f"k{key % 97}-{n}"), codec.encode_insert(insert)))
    for each in came:
        assert isinstance(each, Refused), each
        assert (each.code, each.detail["key"], each.detail["keys"]) == ("unknown_variable", key, [key])


def test_operations_that_there_are_not_say_so(client: Bare) -> None:
    for key in (keys.admin_key("weather"), keys.ask_key("ranges", "weather")):
        came = client.ask(key)
        assert isinstance(came, Refused)
        assert came.code == "unknown_question"


def test_every_refusal_of_an_insert_has_the_next_number(client: Bare) -> None:
    for key in (keys.insert_key("nowhere", "a"), f"{keys.PREFIX}/map/ranges/in/a.b"):
        came = client.ask(key, EDGE)
        assert isinstance(came, Refused)
        assert came.detail["next"] == 1
    key = keys.insert_key("ranges", "numbers")
    for payload, code, following in (
        (b"", "bad_message", 1),
        (codec.encode_insert(Insert(1, Batch((), (edge("x0", "x9"),)))), "unknown_variable", 2),
        (EDGE, "bad_sequence", 2),
        (codec.encode_insert(Insert(2, Batch(), epoch=5)), "wrong_epoch", 2),
        (codec.encode_insert(Insert(900, Batch())), "bad_sequence", 2),
        (b"\x82\xa8sequence\x02\xa1x\xa1\xff", "bad_message", 3),
    ):
        came = client.ask(key, payload)
        assert isinstance(came, Refused), came
        assert (came.code, came.detail["next"]) == (code, following)
    assert isinstance(client.ask(key, codec.encode_insert(Insert(3, Batch()))), bytes)
