"""The bytes of an insert as the event that they are."""

from factorbus.proto import codec
from factorbus.proto.limits import ANSWER_LIMITS, Limits
from factorbus.proto.problems import Problem
from factorbus.service.events import Arrived, Asker, Refuse


def read_insert(asker: Asker, client: str, payload: bytes, limits: Limits, now: float) -> Arrived | Refuse:
    """The arrival of the insert in `payload`; a refusal when not even its sequence number can be read.

    A message that is wrong inside still uses up its number, so that the ones after it need not wait for it.
    """
    try:
        insert = codec.decode_insert(payload, limits)
    except Problem as problem:
        place = _place(payload)
        if place is None:
            return Refuse(asker, problem)
        return Arrived(asker, client, *place, len(payload), hash(payload), problem, now)
    return Arrived(asker, client, insert.sequence, insert.epoch, len(payload), hash(payload), insert, now)


def _place(payload: bytes) -> tuple[int, int] | None:
    """(sequence, epoch) of a message that is otherwise wrong."""
    try:
        content = codec.decode_map(payload, ANSWER_LIMITS)
    except Problem:
        return None
    sequence, epoch = content.get("sequence"), content.get("epoch", 0)
    return (sequence, epoch) if type(sequence) is int and sequence >= 1 and type(epoch) is int else None
