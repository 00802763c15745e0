"""Messages that are not what they should be are refused, and what is wrong is named."""

import runpy
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from factorbus.proto import codec
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.limits import MessageLimits
from factorbus.proto.messages import Batch, Factors, Insert, Variables
from factorbus.proto.problems import BadMessage, BadStamp, TooLarge, UnknownKind

GOLDEN: dict[str, bytes] = runpy.run_path(str(Path(__file__).parents[2] / "proto" / "vectors" / "make.py"))["vectors"]()

GROUP = {"kind": "se2", "keys": b"\0" * 8, "values": b"\0" * 24}
EDGE = {"kind": "between_se2", "keys": b"\0" * 16, "measured": b"\0" * 24, "information": b"\0" * 48}


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({}, "sequence: missing; wanted an integer from 1"),
        ({"sequence": 0}, "sequence: is an integer 0"),
        ({"sequence": True}, "sequence: is a boolean True"),
        ({"sequence": 1.0}, "sequence: is a float 1.0"),
        ({"sequence": 2**63}, "sequence: is an integer"),
        ({"sequence": 1, "epoch": -1}, "epoch: is an integer -1"),
        ({"sequence": 1, "settle": 1}, "settle: is an integer 1; wanted true or false"),
        ({"sequence": 1, "variables": {}}, "variables: is a map; wanted an array of maps"),
        ({"sequence": 1, "variables": [1]}, "variables[0]: is an integer; wanted a map"),
        ({"sequence": 1, "variables": [{}]}, "variables[0].kind: missing"),
        ({"sequence": 1, "variables": [GROUP, GROUP | {"kind": 3}]}, "variables[1].kind: not a string"),
        ({"sequence": 1, "variables": [GROUP | {"keys": "x1"}]}, "variables[0].keys: is a string 'x1'"),
        ({"sequence": 1, "variables": [GROUP | {"keys": b"1234567"}]}, "keys: 7 bytes; wanted a multiple of 8"),
        ({"sequence": 1, "variables": [GROUP | {"values": b"1"}]}, "variables[0].values: 1 byte; wanted 24 (1 row "),
        ({"sequence": 1, "variables": [GROUP | {"values": [0.0]}]}, "variables[0].values: is an array"),
        ({"sequence": 1, "variables": [GROUP | {"fixed": None}]}, "variables[0].fixed: is nil"),
        (
            {"sequence": 1, "variables": [GROUP, GROUP | {"stamps": b"1"}]},
            "variables[1].stamps: 1 byte; wanted 8 (1 int64)",
        ),
        ({"sequence": 1, "variables": [GROUP | {"stamps": b""}]}, "variables[0].stamps: 0 bytes; wanted 8 (1 int64)"),
        *(
            ({"sequence": 1, "variables": [GROUP | {"stamps": wrong}]}, f"variables[0].stamps: is {seen}; wanted a bin")
            for wrong, seen in (
                (True, "a boolean True"),
                (0, "an integer 0"),
                (1.5, "a float 1.5"),
                (float("nan"), "a float nan"),
                (2**63, "an integer 9223372036854775808"),
                ("2026", "a string '2026'"),
                ([1], "an array"),
            )
        ),
        (
            {"sequence": 1, "factors": [EDGE, EDGE | {"keys": b"0" * 17}]},
            "factors[1].keys: 17 bytes; wanted a multiple",
        ),
        ({"sequence": 1, "factors": [EDGE | {"measured": b"0" * 16}]}, "factors[0].measured: 16 bytes; wanted 24"),
        ({"sequence": 1, "factors": [EDGE | {"information": b""}]}, "factors[0].information: 0 bytes; wanted 48"),
        ({"sequence": 1, "factors": [{"kind": "between_se2", "keys": b""}]}, "factors[0].measured: missing"),
        ({"sequence": 1, "factors": [EDGE | {"scale": b"\0" * 8}]}, "factors[0].scale: a scale without a loss"),
    ],
)
def test_what_is_wrong_is_named_by_its_place(content: dict[str, Any], text: str) -> None:
    with pytest.raises(BadMessage) as caught:
        codec.decode_insert(msgpack.packb(content))
    assert text in caught.value.message
    assert caught.value.code == "bad_message"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", r"not readable \(it ends too early\)"),
        (b"\xc1", r"not readable \(a byte 0xc1"),
        (b"\x93\x01", r"not readable \(it ends too early\)"),
        (msgpack.packb([1]), "insert: is an array; wanted a map"),
        (msgpack.packb({"sequence": 1}) + b"\x00", r"not readable \(bytes follow the map\)"),
        (b"\x81\x01\x02", r"not readable \(a key of a map that is no string\)"),
        (b"\x81\x90\x01", r"not readable \(a key of a map that is no string\)"),
        (b"\x81\xa1x\xc6\xff\xff\xff\xff", r"not readable \(it ends too early\)"),
        (b"\x81\xa1x\xa1\xff", r"not readable \(a string that is not UTF-8\)"),
        (b"\x81\xa1x\xc7\x03\xff\x00\x00\x00", r"not readable \(a time stamp that is none\)"),
    ],
)
def test_bytes_that_are_no_map_are_refused(data: bytes, text: str) -> None:
    with pytest.raises(BadMessage, match=text):
        codec.decode_insert(data)


@pytest.mark.parametrize(
    ("data", "size", "limit"),
    [
        (b"\x81\xa8sequence" + b"\x91" * 5000, 1025, 1024),
        (b"\x81\xa1x\xdd\xff\xff\xff\xff", 0xFFFFFFFF, 256),
        (msgpack.packb({"sequence": 1, "variables": [GROUP] * 257}), 257, 256),
        (msgpack.packb({"sequence": 1, "x": {str(n): n for n in range(300)}}), 300, 256),
    ],
)
def test_too_many_levels_groups_or_elements_are_too_large(data: bytes, size: int, limit: int) -> None:
    with pytest.raises(TooLarge) as caught:
        codec.decode_insert(data)
    assert (caught.value.detail["size"], caught.value.detail["limit"]) == (size, limit)
    assert caught.value.message.endswith("; send it flatter") == ("nesting" in caught.value.message)


def test_a_kind_that_is_not_known_is_refused_in_an_insert() -> None:
    with pytest.raises(
        UnknownKind, match="'sim2' is not known here; did you mean 'sim3'\\?; wanted one of se2, se3"
    ) as caught:
        codec.decode_insert(msgpack.packb({"sequence": 1, "variables": [GROUP | {"kind": "sim2"}]}))
    assert (caught.value.code, caught.value.detail["kind"]) == ("unknown_kind", "sim2")
    with pytest.raises(UnknownKind, match="between_se9"):
        codec.decode_graph(msgpack.packb({"epoch": 1, "revision": 1, "factors": [EDGE | {"kind": "between_se9"}]}))


def test_an_older_client_reads_the_values_of_a_kind_it_does_not_know() -> None:
    group = {"kind": "sim2", "keys": b"\0" * 16, "values": np.arange(12.0).tobytes()}
    estimate = codec.decode_estimate(msgpack.packb({"epoch": 1, "revision": 2, "variables": [group]}))
    assert estimate.variables[0].kind == "sim2"
    assert estimate.variables[0].values.shape == (2, 6)


def test_fields_that_are_not_known_are_skipped() -> None:
    plain = {"sequence": 1, "variables": [GROUP], "factors": [EDGE]}
    newer = plain | {"priority": [1, {"a": None}], "variables": [GROUP | {"covariance": b"xyz"}]}
    assert codec.encode_insert(codec.decode_insert(msgpack.packb(newer))) == codec.encode_insert(
        codec.decode_insert(msgpack.packb(plain))
    )


@pytest.mark.parametrize(
    ("limits", "what", "size"),
    [
        (MessageLimits(max_bytes=298, max_variables=9, max_factors=9), "insert has 299 bytes", 299),
        (MessageLimits(max_bytes=999, max_variables=1, max_factors=9), "the batch has 2 variables", 2),
        (MessageLimits(max_bytes=999, max_variables=2, max_factors=0), "the batch has 1 factors", 1),
    ],
)
def test_what_is_over_a_limit_is_refused_with_its_size(limits: MessageLimits, what: str, size: int) -> None:
    with pytest.raises(TooLarge, match=what) as caught:
        codec.decode_insert(GOLDEN["insert"], limits)
    assert caught.value.detail["size"] == size


def test_a_message_cannot_make_itself_large_in_memory() -> None:
    bomb = msgpack.packb({"sequence": 1, "x": [[{}] * 250] * 250})
    assert len(bomb) < 64_000
    codec.decode_insert(bomb)  # small enough to do no harm
    with pytest.raises(TooLarge, match="4097 arrays and maps"):
        codec.decode_insert(msgpack.packb({"sequence": 1, "x": [[[{}] * 250] * 250] * 250}))


@pytest.mark.parametrize(
    "column",
    [[1.5], [float("nan")], ["abc"], [True], np.array([2**63], np.uint64), [2**64], np.array(["2026"], "M8[ns]")],
)
def test_what_is_no_whole_number_is_refused_and_not_cut_to_one(column: Any) -> None:
    stamped = Variables("se2", np.array([7]), None, False, column)
    with pytest.raises(BadStamp, match="stamps"):
        codec.encode_insert(Insert(1, Batch((stamped,))))
    with pytest.raises(BadMessage, match=r"variables\.keys"):
        codec.encode_insert(Insert(1, Batch((Variables("se2", column),))))
    factors = Factors("prior_se2", column, np.zeros((1, 3)), np.ones((1, 6)))
    with pytest.raises(BadMessage, match=r"factors\.keys"):
        codec.encode_insert(Insert(1, Batch((), (factors,))))


def test_whole_numbers_of_other_types_are_taken() -> None:
    for column in ([7], (7,), np.array([7], np.uint8), np.array([7], np.int32)):
        read = codec.decode_insert(
            codec.encode_insert(Insert(1, Batch((Variables("se2", column, None, False, column),))))
        )
        assert read.batch.variables[0].keys.tolist() == read.batch.variables[0].stamps.tolist() == [7]


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("linear_9_se2", "one more: 1 to 4"),
        ("linear_0_se2", "a number of rows from 1 on"),
        ("linear_3_velocity", "'velocity' is no kind of variable"),
        ("linear_1" + 129 * "_se2", "1 to 128 variables"),
        ("linear_1" + 10_000 * "_se2", "of up to 128 variables"),
    ],
)
def test_a_linear_kind_that_there_is_not_is_refused_with_what_is_wrong(kind: str, why: str) -> None:
    keys, numbers = np.zeros((1, 1), np.int64), np.zeros((1, 1))
    sent = codec.encode_insert(Insert(1, Batch(factors=(Factors(kind, keys, numbers, numbers),))))
    with pytest.raises(UnknownKind) as refused:
        codec.decode_insert(sent)
    assert why in str(refused.value)
    assert len(str(refused.value)) < 500
    assert kind not in FACTOR_KINDS
    assert FACTOR_KINDS.get(kind) is None
