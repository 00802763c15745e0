"""Questions about uncertainty and their answers: golden bytes, and readers that take anything without harm."""

import contextlib
import dataclasses
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.proto import asking_codec as codec
from factorbus.proto import closures, components, repair_codec
from factorbus.proto.asking import AskCovariance, Covariances
from factorbus.proto.problems import BadMessage, Problem
from factorbus.proto.symbols import symbol

GOLDEN: dict[str, bytes] = runpy.run_path(str(Path(__file__).parents[2] / "proto" / "vectors" / "make.py"))["vectors"]()
CODECS: dict[str, tuple[Callable[[Any], bytes], Callable[[bytes], Any]]] = {
    "ask_covariance": (codec.encode_ask_covariance, codec.decode_ask_covariance),
    "covariances": (codec.encode_covariances, codec.decode_covariances),
    "ask_gate": (codec.encode_ask_gate, codec.decode_ask_gate),
    "gated": (codec.encode_gated, codec.decode_gated),
    "ask_gain": (codec.encode_ask_gain, codec.decode_ask_gain),
    "gained": (codec.encode_gained, codec.decode_gained),
    "ask_associate": (codec.encode_ask_associate, codec.decode_ask_associate),
    "associated": (codec.encode_associated, codec.decode_associated),
    "ask_why": (codec.encode_ask_why, codec.decode_ask_why),
    "why": (codec.encode_why, codec.decode_why),
    "ask_repair": (repair_codec.encode_ask_repair, repair_codec.decode_ask_repair),
    "repaired": (repair_codec.encode_repaired, repair_codec.decode_repaired),
    "ask_suspects": (closures.encode_ask_suspects, closures.decode_ask_suspects),
    "suspects": (closures.encode_suspects, closures.decode_suspects),
    "components": (components.encode_components, components.decode_components),
    "closure_entry": (closures.encode_closure_entry, closures.decode_closure_entry),
    "closure_entry_ahead": (closures.encode_closure_entry, closures.decode_closure_entry),
}
VECTORS = sorted(name for name in GOLDEN if any(name.startswith(known) for known in CODECS))


def codec_of(vector: str) -> tuple[Callable[[Any], bytes], Callable[[bytes], Any]]:
    return CODECS[max((name for name in CODECS if vector.startswith(name)), key=len)]


@pytest.mark.parametrize("vector", VECTORS)
def test_golden_bytes_are_read_and_written_back(vector: str) -> None:
    encode, decode = codec_of(vector)
    assert encode(decode(GOLDEN[vector])) == GOLDEN[vector]


@pytest.mark.parametrize("vector", VECTORS)
def test_unknown_fields_are_skipped(vector: str) -> None:
    encode, decode = codec_of(vector)
    more = msgpack.packb({**msgpack.unpackb(GOLDEN[vector]), "later": [1, {"x": b"y"}]})
    assert encode(decode(more)) == GOLDEN[vector]


@pytest.mark.parametrize("vector", VECTORS)
def test_fields_that_are_wrong_are_refused_or_were_optional(vector: str) -> None:
    """Every field in turn gone, or of a type that it has not: nothing but a BadMessage comes of it."""
    _, decode = codec_of(vector)
    content = msgpack.unpackb(GOLDEN[vector])
    for name in content:
        for wrong in (
            {k: v for k, v in content.items() if k != name},
            {**content, name: [[1]]},
            {**content, name: b"x"},
        ):
            with contextlib.suppress(BadMessage):
                decode(msgpack.packb(wrong))


@given(data=st.binary(max_size=200), vector=st.sampled_from(VECTORS), cut=st.integers(0, 400))
def test_readers_take_anything_without_harm(data: bytes, vector: str, cut: int) -> None:
    _, decode = codec_of(vector)
    for some in (data, GOLDEN[vector][:cut] + data):
        with contextlib.suppress(Problem):
            decode(some)


def test_a_block_is_found_by_its_key() -> None:
    found = codec.decode_covariances(GOLDEN["covariances"])
    (poses,) = (group for group in found.groups if group.kind == "se2")
    np.testing.assert_array_equal(found["x1"], poses.covariance[poses.keys.tolist().index(symbol("x", 1))])
    assert found[symbol("l", 2)].shape == (2, 2)
    with pytest.raises(KeyError):
        found["x9"]


def test_of_a_question_without_bytes_the_answer_is_the_whole_diagonal() -> None:
    assert codec.decode_ask_covariance(b"") == AskCovariance()


@pytest.mark.parametrize(
    "content",
    [
        {"blocks": "all"},
        {"blocks": "joint"},
        {"blocks": "cross", "keys": b"\0" * 8},
        {"blocks": "relative", "keys": b"\0" * 24},
        {"keys": b"\0" * 7},
    ],
)
def test_questions_that_cannot_be(content: dict[str, Any]) -> None:
    with pytest.raises(BadMessage):
        codec.decode_ask_covariance(msgpack.packb(content))


@pytest.mark.parametrize("probability", [0.0, 1.0, -1.0, 2.0, float("nan"), True, "0.5"])
def test_probabilities_that_cannot_be(probability: Any) -> None:
    content = {**msgpack.unpackb(GOLDEN["ask_gate"]), "probability": probability}
    with pytest.raises(BadMessage, match="probability"):
        codec.decode_ask_gate(msgpack.packb(content))


def test_nothing_is_lost_on_the_way() -> None:
    rng = np.random.default_rng(1)
    sent = Covariances(3, 4, "joint", (), np.arange(4), np.array([3, 2, 6, 3]), covariance=rng.normal(size=(14, 14)))
    got = codec.decode_covariances(codec.encode_covariances(sent))
    for name in (each.name for each in dataclasses.fields(sent)):
        np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))
