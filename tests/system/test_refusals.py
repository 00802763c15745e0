"""Bad input over the bus: refused whole with its code, the map unchanged bit for bit, and the service goes on."""

from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from bare import PATIENCE_S, Bare, bare, edge, keys_of, pose, start

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Factors, Insert, Variables
from factorbus.proto.problems import Refused

NAN = float("nan")


@pytest.fixture(scope="module")
def client(endpoint: str) -> Iterator[Bare]:
    with bare(endpoint) as opened:
        opened.create("refusals")
        for sequence, batch in enumerate((start(), pose("x1", "x0"), pose("x2", "x1")), 1):
            opened.ask(keys.insert_key("refusals", "good"), codec.encode_insert(Insert(sequence, batch)))
        yield opened


def raw(batch: Batch, change: Callable[[dict[str, Any]], Any]) -> bytes:
    """An insert whose MessagePack map was tampered with."""
    content = msgpack.unpackb(codec.encode_insert(Insert(1, batch)))
    change(content)
    return msgpack.packb(content)


def factor(**fields: Any) -> bytes:
    return codec.encode_insert(Insert(1, Batch(factors=(edge("x0", "x1")._replace(**fields),))))


def variable(*groups: Variables) -> bytes:
    return codec.encode_insert(Insert(1, Batch(groups)))


def information(*triangle: float) -> bytes:
    return factor(information=np.array([triangle], float))


GOOD = codec.encode_insert(Insert(1, pose("x3", "x2")))
POINT = Variables("point2", keys_of("l1"), np.zeros((1, 2)))
CASES = {
    "no MessagePack": (b"\xc1\xff", "bad_message"),
    "nothing": (b"", "bad_message"),
    "cut off": (GOOD[:-3], "bad_message"),
    "something behind it": (GOOD + b"\x00", "bad_message"),
    "an array": (msgpack.packb([1, 2]), "bad_message"),
    "no sequence": (raw(Batch(), lambda m: m.pop("sequence")), "bad_message"),
    "sequence 0": (raw(Batch(), lambda m: m.update(sequence=0)), "bad_message"),
    "sequence is text": (raw(Batch(), lambda m: m.update(sequence="1")), "bad_message"),
    "keys cut": (raw(pose("x3", "x2"), lambda m: m["factors"][0].update(keys=b"1234567")), "bad_message"),
    "measured too short": (raw(pose("x3", "x2"), lambda m: m["factors"][0].update(measured=bytes(16))), "bad_message"),
    "values too long": (
        raw(start("x9"), lambda m: m["variables"][0].update(values=bytes(32))),
        "bad_message",
    ),
    "full information": (raw(pose("x3", "x2"), lambda m: m["factors"][0].update(information=bytes(72))), "bad_message"),
    "unknown factor kind": (raw(pose("x3", "x2"), lambda m: m["factors"][0].update(kind="gps")), "unknown_kind"),
    "unknown variable kind": (raw(start("x9"), lambda m: m["variables"][0].update(kind="se4")), "unknown_kind"),
    "NaN value": (variable(Variables("se2", keys_of("x9"), np.array([[0, NAN, 0]]))), "not_finite"),
    "infinite value": (variable(Variables("se2", keys_of("x9"), np.array([[np.inf, 0, 0]]))), "not_finite"),
    "NaN measurement": (factor(measured=np.array([[1, NAN, 0]])), "not_finite"),
    "NaN information": (information(1, 0, 0, NAN, 0, 1), "not_finite"),
    "indefinite information": (information(1, 2, 0, 1, 0, 1), "not_positive_definite"),
    "negative information": (information(-1, 0, 0, 1, 0, 1), "not_positive_definite"),
    "zero information": (information(0, 0, 0, 0, 0, 0), "not_positive_definite"),
    "unknown key": (factor(keys=np.array([keys_of("x0", "x77")])), "unknown_variable"),
    "duplicate key": (codec.encode_insert(Insert(1, pose("x1", "x0"))), "duplicate_variable"),
    "duplicate in itself": (variable(POINT, POINT), "duplicate_variable"),
    "self-loop": (factor(keys=np.array([keys_of("x1", "x1")])), "self_loop"),
    "kind mismatch": (
        codec.encode_insert(
            Insert(
                1,
                Batch(
                    (POINT,), (Factors("between_se2", keys_of("x0", "l1")[None], np.zeros((1, 3)), np.ones((1, 6))),)
                ),
            )
        ),
        "kind_mismatch",
    ),
    "a good half and a bad half": (
        codec.encode_insert(
            Insert(1, Batch((Variables("se2", keys_of("x3")),), (edge("x2", "x3"), edge("x3", "x99"))))
        ),
        "unknown_variable",
    ),
    "nothing holds it": (variable(Variables("se2", keys_of("x9"), np.zeros((1, 3)))), "underconstrained"),
    "no value and no way to one": (variable(Variables("se2", keys_of("x9"))), "uninitialized"),
    "too large": (variable(Variables("se2", np.arange(10_000), np.zeros((10_000, 3)))), "too_large"),
    "too many containers": (raw(Batch(), lambda m: m.update(more=[[[[]]] * 250] * 250)), "too_large"),
    "another epoch": (codec.encode_insert(Insert(1, pose("x3", "x2"), epoch=12345)), "wrong_epoch"),
    "a sequence that skips": (codec.encode_insert(Insert(7, pose("x3", "x2"))), "bad_sequence"),
    "a sequence far ahead": (codec.encode_insert(Insert(7000, pose("x3", "x2"))), "bad_sequence"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_refused_whole(client: Bare, case: str) -> None:
    message, code = CASES[case]
    before = client.estimate("refusals")
    name = "".join(c if c.isalnum() else "-" for c in case)
    refused = client.ask(keys.insert_key("refusals", name), message)
    assert isinstance(refused, Refused), refused
    assert (refused.code, bool(refused.message)) == (code, True)
    assert client.estimate("refusals") == before, "same revision, same bits"


def test_a_repeated_sequence_gets_the_first_answer_and_other_bytes_get_none(client: Bare) -> None:
    key = keys.insert_key("refusals", "repeats")
    first = client.ask(key, codec.encode_insert(Insert(1, pose("y1", "x0"))))
    refused = client.ask(key, codec.encode_insert(Insert(2, pose("y1", "x0"))))
    before = client.estimate("refusals")
    assert isinstance(first, bytes)
    assert isinstance(refused, Refused)
    assert client.ask(key, codec.encode_insert(Insert(1, pose("y1", "x0")))) == first
    again = client.ask(key, codec.encode_insert(Insert(2, pose("y1", "x0"))))
    assert isinstance(again, Refused)
    assert (again.code, again.message) == (refused.code, refused.message) == ("duplicate_variable", refused.message)
    other = client.ask(key, codec.encode_insert(Insert(1, pose("y2", "x0"))))
    assert isinstance(other, Refused)
    assert (other.code, other.detail["next"]) == ("bad_sequence", 3)
    assert client.estimate("refusals") == before


def test_a_bad_message_uses_its_number_up(client: Bare) -> None:
    key = keys.insert_key("refusals", "uses-up")
    bad = client.ask(key, raw(start("x9"), lambda m: m["variables"][0].update(values=b"")))
    assert isinstance(bad, Refused)
    good = client.ask(key, codec.encode_insert(Insert(2, pose("z1", "x0"))))
    assert isinstance(good, bytes), good


@pytest.mark.parametrize(
    ("key", "code"),
    [
        (keys.insert_key("nowhere", "a"), "unknown_map"),
        (keys.ask_key("nowhere", "estimate"), "unknown_map"),
        (keys.ask_key("refusals", "weather"), "unknown_question"),
        (keys.ask_key("refusals", "estimate/x"), "unknown_question"),
        (keys.ask_key("nowhere", "estimate/x/y"), "unknown_map"),
        (keys.admin_key("maps/x"), "unknown_question"),
        (f"{keys.PREFIX}/map/refusals/in/a.b", "bad_name"),
        (f"{keys.PREFIX}/map/refusals/in/good/x", "bad_name"),
        (f"{keys.PREFIX}/map/refusals/in/*", "bad_name"),
    ],
)
def test_what_is_not_there_says_so(client: Bare, key: str, code: str) -> None:
    refused = client.ask(key, GOOD if "/in/" in key else b"")
    assert isinstance(refused, Refused)
    assert refused.code == code


@pytest.mark.parametrize("pattern", ["factorbus/**", f"{keys.PREFIX}/**", f"{keys.PREFIX}/map/**"])
def test_who_asks_a_pattern_is_refused_for_each_key_that_it_meets(client: Bare, pattern: str) -> None:
    waiting, codes = client.send(pattern, GOOD), set()
    while (came := waiting.get(timeout=PATIENCE_S)) is not None:
        assert isinstance(came, Refused)
        codes.add(came.code)
    assert {"bad_name", "unknown_map"} <= codes  # of in/*, ask/* and records/*


@pytest.mark.parametrize(
    ("operation", "content", "code"),
    [
        ("create", {}, "bad_message"),
        ("create", {"map": "a/b"}, "bad_name"),
        ("create", {"map": "a", "mode": "magic"}, "bad_option"),
        ("drop", {"map": "nowhere"}, "unknown_map"),
        ("budget", {"map": "nowhere", "budget_ms": 1.0}, "unknown_map"),
        ("budget", {"map": "nowhere"}, "bad_message"),
        ("budget", {"map": "nowhere", "budget_ms": -1.0}, "bad_option"),
    ],
)
def test_administration_refuses_too(client: Bare, operation: str, content: dict[str, Any], code: str) -> None:
    refused = client.ask(keys.admin_key(operation), codec.encode_map(content))
    assert isinstance(refused, Refused)
    assert refused.code == code


def test_a_map_that_is_dropped_and_made_again_is_another_one(client: Bare) -> None:
    first = client.create("again")
    client.ask(keys.insert_key("again", "a"), codec.encode_insert(Insert(1, start())))
    assert client.create("again") | {"revision": 0, "variables": 0} == first
    assert client.ask(keys.admin_key("drop"), codec.encode_map({"map": "again"})) == codec.encode_map({})
    gone = client.ask(keys.ask_key("again", "estimate"))
    assert isinstance(gone, Refused)
    second = client.create("again")
    assert second["epoch"] != first["epoch"]
    assert (second["revision"], second["variables"]) == (0, 0)
