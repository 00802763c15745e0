"""Ids and answers follow the order in which factors were drafted, though a message has them by kind and loss."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.client import Draft
from factorbus.client.call_order import call_order, reading_columns, reading_ids
from factorbus.proto import asking_codec, codec
from factorbus.proto.asking import Gained
from factorbus.proto.messages import Accepted, Batch
from factorbus.proto.problems import BadMessage

SIGMAS = (0.1, 0.1, 0.02)
KINDS = ["between", "huber", "trusted", "landmark", "linear"]


def drafted(kinds: list[str]) -> Draft:
    """Factors of these kinds; the k-th one is between x<k> and another key."""
    draft = Draft()
    for k, kind in enumerate(kinds):
        if kind == "landmark":
            draft.landmark_se2(f"x{k}", "l0", (1, 0), sigmas=(0.1, 0.1))
        elif kind == "linear":
            draft.linear([f"x{k}"], [(0, 0, 0)], [np.eye(3)], (0, 0, 0), kinds=["se2"], sigmas=SIGMAS)
        else:
            loss = {"loss": "huber"} if kind == "huber" else {}
            draft.between_se2(f"x{k}", "x1000", (1, 0, 0), sigmas=SIGMAS, trusted=kind == "trusted", **loss)
    return draft


def first_keys(batch: Batch) -> list[int]:
    """The first key of each factor, in the order of the message."""
    return [int(row[0]) for group in batch.factors for row in group.keys]


@given(st.lists(st.sampled_from(KINDS), max_size=20))
def test_ids_are_in_the_order_of_the_calls(kinds: list[str]) -> None:
    draft = drafted(kinds)
    sent = first_keys(draft.batch())
    answer = codec.encode_accepted(Accepted(1, 7, 3, 100, 1))
    ids = reading_ids(call_order(draft))(answer).factors
    wanted = sorted(sent)  # x0, x1, ... as drafted
    assert [sent[id_ - 100] for id_ in ids] == wanted
    assert list(reading_ids(call_order(draft.batch()))(answer).factors) == list(range(100, 100 + len(kinds)))


@given(st.lists(st.sampled_from(KINDS), min_size=1, max_size=20))
def test_answers_are_in_the_order_of_the_calls(kinds: list[str]) -> None:
    draft = drafted(kinds)
    gains = np.array(first_keys(draft.batch()), float)
    payload = asking_codec.encode_gained(Gained(7, 3, gains))
    read = reading_columns(asking_codec.decode_gained, ("gain",), call_order(draft))
    assert read(payload).gain.tolist() == sorted(gains)
    columns = list(draft.batch().factors)
    as_sent = reading_columns(asking_codec.decode_gained, ("gain",), call_order(columns))(payload)
    assert as_sent.gain.tolist() == gains.tolist()
    short = asking_codec.encode_gained(replace(as_sent, gain=gains[1:]))
    with pytest.raises(BadMessage, match="one for each candidate"):
        read(short)
