"""Messages of inverse-depth features: golden bytes, round trips, and decoders that take anything without harm."""

import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from naive import dense_idp

from factorbus.proto import codec
from factorbus.proto import features_codec as features
from factorbus.proto.camera import MODELS, BadCamera, Camera
from factorbus.proto.features import FORMS, Ask, Done, FeaturesAnswer, Observations, Segment, Shard, ShardDone
from factorbus.proto.problems import BadMessage, Problem, TooLarge

VECTORS = Path(__file__).parents[2] / "proto" / "vectors" / "features"
MADE: dict[str, bytes] = runpy.run_path(str(VECTORS / "make.py"))["vectors"]()
GOLDEN = {name: (VECTORS / f"{name}.msgpack").read_bytes() for name in MADE}
CONTRACT = (Path(__file__).parents[2] / "proto" / "README.md").read_text()


def again_answer(answer: FeaturesAnswer) -> bytes:
    rows = [(features.encode_shard_done(done.shard), done.worker, done.seconds) for done in answer.shards]
    return features.encode_answer(rows, answer.clean)


# Longest names first: a vector is a message of the first name that it begins with.
MESSAGES: dict[str, tuple[Callable[[bytes], Any], Callable[[Any], bytes]]] = {
    "job_done": (codec.decode_job_done, codec.encode_job_done),
    "job": (codec.decode_job, codec.encode_job),
    "shard_done": (features.decode_shard_done, features.encode_shard_done),
    "shard": (features.decode_shard, features.encode_shard),
    "answer": (features.decode_answer, again_answer),
    "ask": (features.decode_ask, features.encode_ask),
}


def test_every_vector_is_in_the_tree_and_no_other() -> None:
    assert {path.stem for path in VECTORS.glob("*.msgpack")} == set(GOLDEN)
    assert {path.stem for path in VECTORS.glob("*.json")} == set(GOLDEN)


@pytest.mark.parametrize("name", GOLDEN)
def test_the_bytes_of_a_message_never_change(name: str) -> None:
    """What is computed may end in other digits where the C library has another arc tangent."""
    same(msgpack.unpackb(MADE[name]), msgpack.unpackb(GOLDEN[name]))


def same(made: Any, golden: Any, field: str = "") -> None:
    """Alike but for rounding."""
    if isinstance(made, dict):
        assert list(made) == list(golden)
        for each in made:
            same(made[each], golden[each], each)
    elif isinstance(made, list):
        assert len(made) == len(golden)
        for one, other in zip(made, golden, strict=True):
            same(one, other, field)
    elif isinstance(made, bytes) and field in ("ask", "shard", "payload"):
        same(msgpack.unpackb(made), msgpack.unpackb(golden))
    elif isinstance(made, bytes):
        np.testing.assert_allclose(np.frombuffer(made, "<f8"), np.frombuffer(golden, "<f8"), rtol=1e-12, atol=1e-14)
    else:
        assert made == golden


def test_the_answer_answers_the_question() -> None:
    """Against the twin with matrices: y of each pixel, and its covariance with the filter's state and by itself."""
    seen, answer = features.decode_ask(GOLDEN["ask"]).observations, features.decode_answer(GOLDEN["answer"])
    (done,) = answer.shards
    shard, m = done.shard, seen.width
    state, rows = np.asarray(seen.state), np.asarray(shard.rows)
    for i, pixel in enumerate(np.asarray(seen.pixels)):
        y = dense_idp.feature(seen.camera, state, pixel, seen.rho)
        np.testing.assert_allclose(shard.y[i], y, atol=1e-12)
        A = numeric(lambda x, uv=pixel: dense_idp.feature(seen.camera, x, uv, seen.rho), state)
        np.testing.assert_allclose(rows[6 * i : 6 * i + 6, :m], A @ seen.covariance, atol=1e-9)
        B = numeric(lambda uv: dense_idp.feature(seen.camera, state, uv, seen.rho), pixel)
        own = A @ seen.covariance[:, :13] @ A.T + seen.sigma_pixel**2 * B @ B.T
        own[5, 5] += seen.sigma_rho**2
        np.testing.assert_allclose(rows[6 * i : 6 * i + 6, m + 6 * i :][:, :6], own, atol=1e-9)


def numeric(function: Any, at: np.ndarray, h: float = 1e-4) -> np.ndarray:
    """The derivative by central differences of fourth order."""
    steps = h * np.eye(len(at))
    return np.stack(
        [
            (8 * (function(at + e) - function(at - e)) - function(at + 2 * e) + function(at - 2 * e)) / (12 * h)
            for e in steps
        ],
        axis=1,
    )


@pytest.mark.parametrize("name", GOLDEN)
def test_the_description_says_what_is_in_the_bytes(name: str) -> None:
    description = json.loads((VECTORS / f"{name}.json").read_text())
    assert msgpack.packb(from_description(description)) == GOLDEN[name]


@pytest.mark.parametrize("name", GOLDEN)
def test_decoding_and_encoding_gives_the_golden_bytes_again(name: str) -> None:
    decode, encode = next(both for message, both in MESSAGES.items() if name.startswith(message))
    assert encode(decode(GOLDEN[name])) == GOLDEN[name]


def from_description(content: Any) -> Any:
    if isinstance(content, dict):
        match content:
            case {"f64": numbers}:
                return np.array(numbers, "<f8").tobytes()
            case {"msgpack": inner}:
                return msgpack.packb(from_description(inner))
        return {key: from_description(value) for key, value in content.items()}
    return [from_description(item) for item in content] if isinstance(content, list) else content


DOUBLES = st.floats(allow_nan=True, allow_infinity=True, width=64)
NUMBER = st.floats(0.01, 100.0)


def block(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return arrays("<f8", shape, elements=DOUBLES)


@st.composite
def asks(draw: st.DrawFn) -> Ask:
    model = draw(st.sampled_from(sorted(MODELS)))
    size = draw(st.sampled_from([(0, 0), (640, 480)]))
    camera = Camera(model, tuple(draw(NUMBER) for _ in MODELS[model]), *size)
    m, n = draw(st.integers(13, 30)), draw(st.integers(0, 5))
    observations = Observations(
        camera, draw(block(13)), draw(block(13, m)), draw(block(n, 2)), *(draw(NUMBER) for _ in "123")
    )
    size_ = st.integers(0, 2**62)
    segment = st.builds(Segment, size_, size_, st.text(max_size=9), size_, size_)
    return Ask(observations, draw(st.sampled_from(FORMS)), draw(st.none() | segment))


@st.composite
def shards_done(draw: st.DrawFn) -> ShardDone:
    first, k, m = draw(st.integers(0, 9)), draw(st.integers(1, 3)), draw(st.integers(13, 15))
    shapes = {"rows": (6 * k, m + 6), "cross": (6 * k, m), "blocks": (36,), "turn": (k, 4), "own": (k, 3)}
    shapes |= {"U": (6, m), "S": (3, 3)}
    chosen = draw(st.sets(st.sampled_from(sorted(shapes))))
    parts = {name: draw(block(*shapes[name])) for name in chosen}
    return ShardDone(first, first + k, draw(block(k, 6)), **parts, stored=draw(st.booleans()))


@given(asks())
def test_an_ask_survives(ask: Ask) -> None:
    came = features.decode_ask(features.encode_ask(ask))
    assert (came.form, came.segment, came.observations.camera) == (ask.form, ask.segment, ask.observations.camera)
    for name in ("state", "covariance", "pixels"):
        sent, got = getattr(ask.observations, name), getattr(came.observations, name)
        assert (sent.shape, sent.tobytes()) == (got.shape, got.tobytes())
    for name in ("rho", "sigma_rho", "sigma_pixel"):
        assert getattr(ask.observations, name) == getattr(came.observations, name)


@given(shards_done())
def test_a_done_shard_survives(shard: ShardDone) -> None:
    (done,), clean = features.decode_answer(
        features.encode_answer([(features.encode_shard_done(shard), "w", 0.5)], True)
    )
    assert (done.worker, done.seconds, clean) == ("w", 0.5, True)
    for name, sent in shard._asdict().items():
        got = getattr(done.shard, name)
        if isinstance(sent, np.ndarray):
            assert (sent.shape, sent.tobytes()) == (got.shape, got.tobytes()), name
        else:
            assert sent == got


@given(st.sampled_from(sorted(GOLDEN)), st.data())
def test_decoders_take_anything(name: str, data: st.DataObject) -> None:
    """Cut short, with bytes changed: a message or a problem, nothing else."""
    golden = bytearray(GOLDEN[name])
    for _ in range(data.draw(st.integers(0, 3))):
        golden[data.draw(st.integers(0, len(golden) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(golden[: data.draw(st.integers(0, len(golden)))])
    for decode, _ in MESSAGES.values():
        try:
            decode(cut)
        except (BadMessage, BadCamera, TooLarge):
            continue


@given(asks(), st.sampled_from(["state", "covariance", "pixels", "camera", "rho"]), st.data())
def test_a_field_of_another_type_or_length_is_refused(ask: Ask, name: str, data: st.DataObject) -> None:
    content = msgpack.unpackb(features.encode_ask(ask))
    content[name] = data.draw(st.none() | st.text(max_size=3) | st.binary(max_size=7) | st.lists(st.none(), max_size=1))
    assume(not (name == "pixels" and content[name] == b""))
    with pytest.raises(Problem) as refused:
        features.decode_ask(msgpack.packb(content))
    assert refused.value.code in ("bad_message", "bad_camera")


def test_every_field_is_explained() -> None:
    names = {*Ask._fields, *Segment._fields, *Shard._fields, *ShardDone._fields, *FeaturesAnswer._fields, *Done._fields}
    names |= {"camera", "state", "covariance", "pixels", "rho", "sigma_rho", "sigma_pixel", "model", "numbers", *FORMS}
    names -= {"observations"}
    assert not {name for name in names if f"`{name}`" not in CONTRACT}
    assert not {name for name in MODELS if f"`{name}`" not in CONTRACT}
    for code in ("bad_camera", "bad_pixel", "bad_state"):
        assert f"`{code}`" in CONTRACT
