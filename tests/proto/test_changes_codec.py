"""Changes on the wire: what is wrong with one is named by its place, and nothing but a Problem comes of it."""

from typing import Any

import msgpack
import numpy as np
import pytest

from factorbus.proto import codec
from factorbus.proto.kinds import CHANGES
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.proto.problems import BadMessage

TWO = np.array([3, 5]).tobytes()
NUMBERS = np.array([1.0, 2.0]).tobytes()
GOOD: dict[str, dict[str, Any]] = {
    "remove_factors": {"factors": TWO},
    "remove_variables": {"keys": TWO, "alone": True},
    "loss": {"factors": TWO, "loss": "dcs", "scale": NUMBERS},
    "weigh": {"factors": TWO, "weight": NUMBERS},
    "fix": {"keys": TWO},
    "free": {"keys": TWO},
    "marginalize": {"keys": TWO},
    "accept": {"factors": TWO},
    "reject": {"factors": TWO},
    "place": {"kind": "point2", "keys": TWO, "values": 2 * NUMBERS},
}


def insert_with(change: dict[str, Any]) -> bytes:
    return msgpack.packb({"sequence": 1, "changes": [{"change": "fix", "keys": b""}, change]})


def test_these_are_all_changes_there_are() -> None:
    assert GOOD.keys() == CHANGES.keys()


@pytest.mark.parametrize("name", GOOD)
def test_each_is_read_as_it_was_written(name: str) -> None:
    (_, change) = codec.decode_insert(insert_with({"change": name, "later": 1, **GOOD[name]})).changes
    again = codec.decode_insert(codec.encode_insert(Insert(1, Batch(), changes=(change,)))).changes[0]
    assert repr(again) == repr(change)
    named = change.keys if CHANGES[name].names == "keys" else change.factors
    assert named is not None
    assert named.tolist() == [3, 5]


@pytest.mark.parametrize(
    ("name", "wrong", "where"),
    [
        (name, {field: wrong}, field)
        for name, fields in GOOD.items()
        for field in fields
        if field not in ("alone", "loss")
        for wrong in (None, 7, b"1234567")
    ]
    + [
        ("remove_variables", {"alone": 1}, "alone"),
        ("loss", {"loss": "square"}, "loss"),
        ("loss", {"loss": 1}, "loss"),
        ("loss", {"loss": None}, "scale"),
        ("place", {"kind": "se9"}, "kind"),
        ("place", {"values": NUMBERS}, "values"),
        ("weigh", {"weight": NUMBERS[:8]}, "weight"),
        ("unmake", {}, "change"),
        (None, {}, "change"),
    ],
)
def test_what_is_wrong_is_named(name: str | None, wrong: dict[str, Any], where: str) -> None:
    content = {"change": name, **GOOD.get(name or "", {}), **wrong}
    with pytest.raises(BadMessage, match=rf"changes\[1\]\.{where}"):
        codec.decode_insert(insert_with(content))


def test_a_client_that_sends_no_changes_sends_the_bytes_that_it_always_sent() -> None:
    assert b"changes" not in codec.encode_insert(Insert(1, Batch()))
    assert codec.decode_insert(codec.encode_insert(Insert(1, Batch()))).changes == ()
    assert Change("fix") == ("fix", None, None, "", None, None, False, "", None, False)
