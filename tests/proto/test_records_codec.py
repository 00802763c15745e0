"""Messages of replicas: bytes both ways, and what is refused."""

import runpy
import zlib
from pathlib import Path

import pytest

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.problems import BadMessage, Busy, Problem, TooLarge
from factorbus.proto.records import (
    JournalPlace,
    RecordsAnswer,
    RecordsAsk,
    RecordsPush,
    SentInsert,
    SentRecord,
    decode_records_answer,
    decode_records_ask,
    decode_records_push,
    encode_records_answer,
    encode_records_ask,
    encode_records_push,
    with_messages,
)

GOLDEN: dict[str, bytes] = runpy.run_path(str(Path(__file__).parents[2] / "proto" / "vectors" / "make.py"))["vectors"]()
PLACE = JournalPlace(3, bytes(range(16)))
MOST = 1 << 20


def digest(message: bytes) -> int:
    return len(message)


def test_golden_messages_come_back_as_they_were() -> None:
    for name in ("ask_records", "ask_records_named"):
        assert encode_records_ask(decode_records_ask(GOLDEN[name], REQUEST_LIMITS)) == GOLDEN[name]
    none, push = GOLDEN["records_answer_none"], GOLDEN["records_push"]
    assert encode_records_answer(decode_records_answer(none, digest)) == none
    assert encode_records_push(decode_records_push(push, digest, MOST)) == push
    assert decode_records_ask(GOLDEN["ask_records_named"], REQUEST_LIMITS) == RecordsAsk(PLACE, (4711, 12), 4096)


def test_inserts_in_records_are_arrays_as_the_contract_has_them() -> None:
    told = codec.encode_problem(Busy(1, 0.1))
    rows = [[4, 0, [["robot1-5f", 2, b"\x80"], ["r2", 1, 4711]]], [4, 2, [["r2", 2, b"\x80", 1, told]]]]
    content = {"epoch": 17, "record": 5, "chain": bytes(16), "records": rows, "more": True}
    answer = decode_records_answer(codec.encode_map(content), digest)
    taken = SentRecord(4, (SentInsert("robot1-5f", 2, b"\x80", 1), SentInsert("r2", 1, b"", 4711)))
    refused = SentRecord(4, (SentInsert("r2", 2, b"\x80", 1, 1, told),), rebuilt=True)
    assert answer == RecordsAnswer(17, JournalPlace(5, bytes(16)), (taken, refused), more=True)
    assert decode_records_answer(encode_records_answer(answer), digest) == answer


def test_many_records_are_compressed_and_come_back() -> None:
    inserts = tuple(SentInsert("robot", n, b"variables factors" * 3, 51) for n in range(1, 40))
    push = RecordsPush(PLACE, tuple(SentRecord(n, (insert,)) for n, insert in enumerate(inserts)))
    message = encode_records_push(push)
    assert len(message) < sum(len(insert.message) for insert in inserts) / 2
    assert decode_records_push(message, digest, MOST) == push


def test_messages_that_were_named_are_filled_in() -> None:
    named = (SentRecord(1, (SentInsert("robot", 1, b"", 3),)),)
    assert with_messages(named, {3: b"abc"})[0].inserts[0].message == b"abc"
    with pytest.raises(BadMessage):
        with_messages(named, {4: b"abcd"})


@pytest.mark.parametrize(
    "change",
    [
        {"chain": b"short"},
        {"chain": None},
        {"record": -1},
        {"records": {}},
        {"records": [[1, 0]]},
        {"records": [[1, 4, []]]},
        {"records": [[1, 0, [["robot", 0, b"m"]]]]},
        {"records": [[1, 0, [["no name", 1, b"m"]]]]},
        {"records": [[1, 0, [["robot", 1, b""]]]]},
        {"records": [[1, 0, [["robot", 1, True]]]]},
        {"records": [[1, 0, [["robot", 1, b"m", 3, b"p"]]]]},
        {"records": [[1, 0, [["robot", 1, b"m", 1, b""]]]]},
        {"records": [[1, 0, [["robot", 1, b"m", 1]]]]},
        {"zlib": b"no such thing"},
        {"zlib": zlib.compress(codec.encode_map({"records": []}))[:-5]},
    ],
)
def test_what_is_no_message_is_refused(change: dict[str, object]) -> None:
    content = {"record": 3, "chain": bytes(16), "records": [], "epoch": 1} | change
    with pytest.raises(BadMessage):
        decode_records_push(codec.encode_map(content), digest, MOST)


def test_what_is_small_only_while_it_is_compressed_is_refused() -> None:
    packed = zlib.compress(codec.encode_map({"records": [], "filling": bytes(4 << 20)}))
    with pytest.raises(TooLarge):
        decode_records_push(codec.encode_map({"record": 0, "chain": bytes(16), "zlib": packed}), digest, MOST)


def test_a_question_names_whole_digests() -> None:
    with pytest.raises(Problem):
        decode_records_ask(codec.encode_map({"record": 0, "chain": bytes(16), "named": b"1234567"}), REQUEST_LIMITS)


def test_an_answer_without_records_is_short() -> None:
    assert len(encode_records_answer(RecordsAnswer(1 << 61, PLACE))) < 60
