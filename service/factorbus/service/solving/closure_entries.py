"""Verdicts on loop closures as entries behind the insert that brought them about."""

from typing import Any

from factorbus.proto import codec
from factorbus.proto.closures import ClosureEntry
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.messages import Batch, Insert
from factorbus.proto.own_clients import JUDGE
from factorbus.service.core.events import Arrived, ParsedInsert
from factorbus.service.kernels.digest import digest
from factorbus.solver.closures.ledger import ClosureVerdicts


def entry_again(message: bytes, content: ClosureEntry) -> Arrived:
    """Verdicts as an entry, which nobody waits for."""
    return Arrived([], JUDGE, content.sequence, 0, len(message), int(digest(message)), content, 0.0, message)


def is_ahead(content: object) -> bool:
    """Whether it is an entry of verdicts that were applied with the insert before it."""
    return isinstance(content, ClosureEntry) and content.ahead


def verdicts_of_entry(entry: Any) -> ClosureVerdicts:
    """What it says of closures."""
    return ClosureVerdicts(*(getattr(entry, name) for name in ClosureVerdicts._fields))


def batch_of_insert(insert: Arrived) -> Batch | None:
    """What an insert adds; None of one that is wrong."""
    content = insert.content
    if isinstance(content, ParsedInsert):
        return codec.decode_insert(content.message, ANSWER_LIMITS).batch
    return content.batch if isinstance(content, Insert) else None
