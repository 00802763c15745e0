"""The bytes of an insert as the event that they are."""

import numpy as np

from factorbus.proto import codec
from factorbus.proto.limits import ANSWER_LIMITS, MessageLimits
from factorbus.proto.messages import Insert
from factorbus.proto.place import find_place
from factorbus.proto.problems import Problem
from factorbus.service.core.events import Arrived, Asker, ParsedInsert, Refuse
from factorbus.service.kernels.digest import digest
from factorbus.service.kernels.read import read_insert as read_usual
from factorbus.service.kernels.words import LETTERS, WORDS
from factorbus.solver.kernels.model import layout

# Of messages above this size, looking closely is a small part of the work; and so many groups are no usual message.
_SHORT_BYTES = 16 << 10
_GROUPS = 30
_SHAPE = (_GROUPS + 1, layout.G_WIDTH)


def read_insert(asker: Asker, client: str, payload: bytes, limits: MessageLimits, now: float) -> Arrived | Refuse:
    """The arrival of the insert in `payload`; a refusal when not even its sequence number can be read.

    A message that is wrong inside still uses up its number, so that the ones after it need not wait for it; whether it
    did, `detail.next` tells.
    """
    size = len(payload)
    if size <= _SHORT_BYTES and (located := try_locate(payload, limits)):
        sequence, epoch, digest, content = located
        return Arrived([asker], client, sequence, epoch, size, digest, content, now, payload)
    try:
        insert = codec.decode_insert(payload, limits)
    except Problem as problem:
        place = find_place(payload)
        if place is None:
            return Refuse(asker, problem)
        return Arrived([asker], client, *place, size, message_digest(payload), problem, now, payload)
    return Arrived([asker], client, insert.sequence, insert.epoch, size, message_digest(payload), insert, now, payload)


def read_again(payload: bytes) -> tuple[int, Insert | ParsedInsert | Problem]:
    """(digest, content) of an insert that was read before, as `read_insert` has them."""
    if len(payload) <= _SHORT_BYTES and (located := try_locate(payload, ANSWER_LIMITS)):
        return located[2:]
    try:
        return message_digest(payload), codec.decode_insert(payload, ANSWER_LIMITS)
    except Problem as problem:
        return message_digest(payload), problem


def try_locate(payload: bytes, limits: MessageLimits) -> tuple[int, int, int, ParsedInsert] | None:
    """(sequence, epoch, digest, content) of a usual insert, which `codec.decode_insert` accepts; None: ask that."""
    size = len(payload)
    # A key is eight bytes: without counting, no more than this can be in it.
    if size > limits.max_bytes or size > 8 * limits.max_variables or size > 8 * limits.max_factors:
        return None
    groups = np.empty(_SHAPE, np.int64)
    sequence, epoch, settle, digest = read_usual(payload, WORDS, LETTERS, groups)
    if not sequence:
        return None
    return int(sequence), int(epoch), int(digest), ParsedInsert(payload, groups, bool(settle))


def message_digest(message: bytes) -> int:
    """63 bits that tell an insert from another of the same number: the same in every process, unlike Python's hash."""
    return int(digest(message))
