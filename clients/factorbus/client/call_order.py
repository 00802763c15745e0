"""The order in which factors were drafted, which ids and answers follow, though a message has them by kind and loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from factorbus.client.draft import Draft
from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch
from factorbus.proto.problems import BadMessage

_Answer = TypeVar("_Answer")


def call_order(given: Batch | Draft | Sequence[Any]) -> Sequence[int]:
    """The place in the message of each factor, as they were drafted; of columns as they are."""
    if isinstance(given, Draft):
        return given.order()
    if isinstance(given, Batch):
        return range(given.factor_count)
    return range(Batch((), tuple(given)).factor_count)


def reading_ids(order: Sequence[int]) -> Callable[[bytes], Accepted]:
    """Reads the answer to an insert, and names its factors in the order in which they were drafted."""

    def read(payload: bytes) -> Accepted:
        accepted = codec.decode_accepted(payload)
        first = accepted.first_factor
        ids = range(first, first + len(order)) if isinstance(order, range) else [first + k for k in order]
        return replace(accepted, factors=ids)

    return read


def reading_columns(
    decode: Callable[[bytes], _Answer], names: Sequence[str], order: Sequence[int]
) -> Callable[[bytes], _Answer]:
    """Reads an answer with columns of a row for each candidate, in the order in which these were drafted.

    What it gives raises BadMessage where the answer has not as many rows as there were candidates.
    """

    def read(payload: bytes) -> _Answer:
        answer: Any = decode(payload)
        rows = len(getattr(answer, names[0]))
        if rows != len(order):
            raise BadMessage(names[0], f"{rows} rows", f"{len(order)}, one for each candidate")
        if isinstance(order, range):
            return answer
        places = np.array(order, np.int64)
        return replace(answer, **{name: getattr(answer, name)[places] for name in names})

    return read
