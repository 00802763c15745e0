"""What a replica and its upstream tell each other of a map's journal, and its bytes, both ways.

    ask/records               what the journal has after a record; what the asker has by itself is named, not sent
    map/<map>/records/<name>  records to go on with: they are taken as they are, or not at all

A place in a journal is the number of a record and the chain (16 bytes) that its owner has told for it.
Every reader raises BadMessage, TooLarge.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto import fields
from factorbus.proto.codec import decode_map, encode_map
from factorbus.proto.keys import is_name
from factorbus.proto.limits import ANSWER_LIMITS, MessageLimits
from factorbus.proto.own_clients import OWN_CLIENTS
from factorbus.proto.problems import BadMessage, TooLarge
from factorbus.wording import counted

START_CHAIN = bytes(16)  # before the first record
MOST_RECORDS, MOST_NAMED = 256, 4096  # in one message; inserts that an asker may name
MOST_BYTES = 256 << 10  # of the messages in an answer, unless the asker wants fewer
_FURTHER, _REBUILT = 1, 2
_MOST_UNITS = 2**62  # of work, which a budget is counted in
_OUTCOMES = (0, 1, 2)  # accepted, refused by the solver, refused before


class JournalPlace(NamedTuple):
    """A record, and the chain that the owner of the journal has told for it."""

    record: int = 0
    chain: bytes = START_CHAIN


class SentInsert(NamedTuple):
    """An insert in its place.  message: empty where the receiver has it, which `digest` names.

    outcome: accepted (0), refused by the solver (1) or before (2).  problem: what a refused one was answered.
    """

    client: str
    sequence: int
    message: bytes
    digest: int
    outcome: int = 0
    problem: bytes = b""


class SentRecord(NamedTuple):
    """What a journal has of one batch: its inserts in order, and the revision that came of it.

    further: a step without an insert.  rebuilt: the solver was replaced meanwhile.  budget: what each of its steps
    might take, in units of the solver's work; 0: they had no bound.
    """

    revision: int
    inserts: tuple[SentInsert, ...]
    further: bool = False
    rebuilt: bool = False
    budget: float = 0.0


class RecordsPush(NamedTuple):
    """Go on with `records`, if your journal ends at `after`."""

    after: JournalPlace
    records: tuple[SentRecord, ...]


class RecordsAsk(NamedTuple):
    """What does your journal have after `after`?  named: digests of inserts that need no message.

    most_bytes: of messages, but for the last of them.
    """

    after: JournalPlace
    named: tuple[int, ...] = ()
    most_bytes: int = MOST_BYTES


class RecordsAnswer(NamedTuple):
    """To both: where the journal is with `records`.  more: there are more behind them.

    same: what was pushed came to the outcomes that were told with it.
    """

    epoch: int
    place: JournalPlace
    records: tuple[SentRecord, ...] = ()
    more: bool = False
    same: bool = True


def encode_records_push(push: RecordsPush) -> bytes:
    """Bytes of a push."""
    return encode_map(_place_map(push.after) | _packed(push.records))


def decode_records_push(data: bytes, digest_of: Callable[[bytes], int], most_bytes: int) -> RecordsPush:
    """A push; `digest_of` a message."""
    limits = replace(ANSWER_LIMITS, max_bytes=most_bytes)
    content = decode_map(data, limits, "records")
    return RecordsPush(_place("records", content), _records(content, digest_of, limits))


def encode_records_ask(ask: RecordsAsk) -> bytes:
    """Bytes of a question."""
    content = _place_map(ask.after)
    if ask.named:
        content["named"] = np.array(ask.named, fields.I8).tobytes()
    if ask.most_bytes != MOST_BYTES:
        content["most_bytes"] = ask.most_bytes
    return encode_map(content)


def decode_records_ask(data: bytes, limits: MessageLimits) -> RecordsAsk:
    """A question."""
    content = decode_map(data, limits, "records")
    named = fields.binary("records", content, "named") if content.get("named") is not None else b""
    if len(named) % 8 or len(named) > 8 * MOST_NAMED:
        raise BadMessage(
            "records.named", f"has {counted(len(named), 'byte')}", f"8 for each digest, at most {8 * MOST_NAMED}"
        )
    most_bytes = fields.integer("records", content, "most_bytes", 1, MOST_BYTES)
    digests = tuple(np.frombuffer(named, fields.I8).tolist())
    return RecordsAsk(_place("records", content), digests, min(most_bytes, MOST_BYTES))


def encode_records_answer(answer: RecordsAnswer) -> bytes:
    """Bytes of an answer."""
    content: dict[str, Any] = {"epoch": answer.epoch} | _place_map(answer.place)
    content |= _packed(answer.records)
    if answer.more:
        content["more"] = True
    if not answer.same:
        content["same"] = False
    return encode_map(content)


def decode_records_answer(data: bytes, digest_of: Callable[[bytes], int]) -> RecordsAnswer:
    """An answer; `digest_of` a message."""
    content = decode_map(data, what="records")
    return RecordsAnswer(
        fields.integer("records", content, "epoch"),
        _place("records", content),
        _records(content, digest_of, ANSWER_LIMITS),
        fields.flag("records", content, "more"),
        fields.flag("records", content, "same", True),
    )


def _place_map(place: JournalPlace) -> dict[str, Any]:
    return {"record": place.record, "chain": place.chain}


def _place(where: str, content: fields.Map) -> JournalPlace:
    chain = fields.binary(where, content, "chain")
    if len(chain) != len(START_CHAIN):
        raise BadMessage(f"{where}.chain", f"has {counted(len(chain), 'byte')}", f"{len(START_CHAIN)}")
    return JournalPlace(fields.integer(where, content, "record"), chain)


def _row(record: SentRecord) -> list[Any]:
    flags = _FURTHER * record.further + _REBUILT * record.rebuilt
    row = [record.revision, flags, [_columns(insert) for insert in record.inserts]]
    return [*row, round(record.budget)] if record.budget else row


def _columns(insert: SentInsert) -> list[Any]:
    row = [insert.client, insert.sequence, insert.message or insert.digest]
    return [*row, insert.outcome, insert.problem] if insert.outcome else row


def _packed(records: Sequence[SentRecord]) -> dict[str, Any]:
    """Records have names and numbers in common, so they are compressed where that makes them smaller."""
    if not records:
        return {}
    rows = {"records": [_row(record) for record in records]}
    plain = encode_map(rows)
    small = zlib.compress(plain)
    return {"zlib": small} if len(small) < len(plain) else rows


def _unpacked(small: bytes, limits: MessageLimits) -> fields.Map:
    """Raises BadMessage, TooLarge before more than that has been unpacked."""
    reader = zlib.decompressobj()
    try:
        plain = reader.decompress(small, limits.max_bytes)
    except zlib.error as error:
        raise BadMessage("records.zlib", f"cannot be unpacked ({error})", "zlib (RFC 1950)") from None
    if reader.unconsumed_tail:
        raise TooLarge("records", limits.max_bytes + 1, limits.max_bytes, "bytes")
    if not reader.eof:
        raise BadMessage("records.zlib", "ends too early", "zlib (RFC 1950), whole")
    return decode_map(plain, limits, "records")


def _records(content: fields.Map, digest_of: Callable[[bytes], int], limits: MessageLimits) -> tuple[SentRecord, ...]:
    if content.get("zlib") is not None:
        content = _unpacked(fields.binary("records", content, "zlib"), limits)
    rows = content.get("records", [])
    if not isinstance(rows, list) or len(rows) > MOST_RECORDS:
        raise BadMessage("records.records", "is no list of them", f"an array of at most {MOST_RECORDS} records")
    return tuple(_record(n, row, digest_of) for n, row in enumerate(rows))


def _record(n: int, row: Any, digest_of: Callable[[bytes], int]) -> SentRecord:
    where = f"records.records[{n}]"
    match row:
        case [int(revision), int(flags), [*inserts], *budget] if revision >= 0 and 0 <= flags <= _FURTHER + _REBUILT:
            sent = tuple(_insert(f"{where}[2][{k}]", each, digest_of) for k, each in enumerate(inserts))
            return SentRecord(revision, sent, bool(flags & _FURTHER), bool(flags & _REBUILT), _budget(where, budget))
    raise BadMessage(where, "is something else", "[revision, flags, inserts], and budget where there was one")


def _budget(where: str, columns: list[Any]) -> float:
    match columns:
        case []:
            return 0.0
        case [int(budget)] if 0 < budget < _MOST_UNITS and budget is not True:
            return float(budget)
    raise BadMessage(
        f"{where}[3]",
        "is something else",
        "the units of work that each step might take, an integer from 1 to 2⁶², and nothing more",
    )


def _insert(where: str, row: Any, digest_of: Callable[[bytes], int]) -> SentInsert:
    if not isinstance(row, list) or len(row) not in (3, 5):
        raise BadMessage(where, "is something else", "[client, sequence, message], and where refused outcome, problem")
    client, sequence, message = row[:3]
    outcome, problem = row[3:] or (0, b"")
    if not (is_name(client) or client in OWN_CLIENTS) or not _is_whole(sequence) or sequence < 1:
        raise BadMessage(where, "has no client or number", "a client's name and a number from 1")
    if outcome not in _OUTCOMES or not isinstance(problem, bytes) or bool(problem) != bool(outcome):
        raise BadMessage(where, f"has the outcome {outcome!r}", "1 or 2, and the problem that it was answered")
    if isinstance(message, bytes) and message:
        return SentInsert(client, sequence, message, digest_of(message), outcome, problem)
    if isinstance(message, bytes) or not _is_whole(message):
        raise BadMessage(where, "has neither message nor digest", "bytes, or the digest of what you named")
    return SentInsert(client, sequence, b"", int(message), outcome, problem)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def with_messages(records: Sequence[SentRecord], had: Mapping[int, bytes]) -> tuple[SentRecord, ...]:
    """`records` with the messages that were named; `had`: by digest.  Raises BadMessage for one that was not."""

    def whole(insert: SentInsert) -> SentInsert:
        if insert.message:
            return insert
        if (message := had.get(insert.digest)) is None:
            raise BadMessage("records", f"name an insert of {insert.client} that was not named", "its message")
        return insert._replace(message=message)

    return tuple(record._replace(inserts=tuple(map(whole, record.inserts))) for record in records)
