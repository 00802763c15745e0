"""The bytes of an insert as the event that they are."""

import numpy as np

from factorbus.proto import codec
from factorbus.proto.limits import ANSWER_LIMITS, MessageLimits
from factorbus.proto.messages import Insert
from factorbus.proto.place import find_place
from factorbus.proto.problems import Problem, without_frames
from factorbus.service.core.events import Arrived, Asker, ParsedInsert, Refuse
from factorbus.service.kernels.digest import digest
from factorbus.service.kernels.read import MORE_GROUPS, locate_insert
from factorbus.solver.kernels.graph import group_table as gt

# Groups of a usual message, and the most that a decoder of requests takes: the first are read in one go.
_GROUPS, _MOST_GROUPS = 30, 512


def read_insert(asker: Asker, client: str, payload: bytes, limits: MessageLimits, now: float) -> Arrived | Refuse:
    """The arrival of the insert in `payload`; a refusal when not even its sequence number can be read.

    A message that is wrong inside still uses up its number, so that the ones after it need not wait for it; whether it
    did, `detail.next` tells.
    """
    size = len(payload)
    if parsed := try_parse(payload, limits):
        sequence, epoch, digest, content = parsed
        return Arrived([asker], client, sequence, epoch, size, digest, content, now, payload)
    try:
        insert = codec.decode_insert(payload, limits)
    except Problem as problem:
        place = find_place(payload)
        if place is None:
            return Refuse(asker, problem)
        return Arrived([asker], client, *place, size, message_digest(payload), without_frames(problem), now, payload)
    return Arrived([asker], client, insert.sequence, insert.epoch, size, message_digest(payload), insert, now, payload)


def read_again(payload: bytes) -> tuple[int, Insert | ParsedInsert | Problem]:
    """(digest, content) of an insert that was read before, as `read_insert` has them."""
    if parsed := try_parse(payload, ANSWER_LIMITS):
        return parsed[2:]
    try:
        return message_digest(payload), codec.decode_insert(payload, ANSWER_LIMITS)
    except Problem as problem:
        return message_digest(payload), without_frames(problem)


def try_parse(payload: bytes, limits: MessageLimits) -> tuple[int, int, int, ParsedInsert] | None:
    """(sequence, epoch, digest, content) of an insert that only adds and that `codec.decode_insert` accepts; None: it
    has changes or fields of a later version, or there is something wrong with it, which that says."""
    if len(payload) > limits.max_bytes:
        return None
    groups = np.empty((_GROUPS + 1, gt.G_WIDTH), np.int64)
    found = locate_insert(payload, groups)
    if found[0] == MORE_GROUPS:
        groups = np.empty((_MOST_GROUPS + 1, gt.G_WIDTH), np.int64)
        found = locate_insert(payload, groups)
    sequence, epoch, settle, below, digest, variables, factors = found
    if sequence <= 0 or variables > limits.max_variables or factors > limits.max_factors:
        return None
    return sequence, epoch, digest, ParsedInsert(payload, groups, settle, below, variables, factors)


def message_digest(message: bytes) -> int:
    """63 bits that tell an insert from another of the same number: the same in every process, unlike Python's hash."""
    return int(digest(message))
