"""Messages to bytes and back: golden bytes, round trips, and decoders that take anything without harm."""

import json
import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from factorbus.proto import codec, interest_codec
from factorbus.proto.kinds import CHANGES, FACTOR_KINDS, LOSSES, VARIABLE_KINDS, FactorKind
from factorbus.proto.messages import (
    Accepted,
    Batch,
    Change,
    Chi2,
    Delta,
    Estimate,
    Factors,
    Insert,
    Job,
    JobDone,
    MapGraph,
    Optimum,
    Variables,
)
from factorbus.proto.problems import BadMessage, Problem, Refused, TooLarge, UnknownMap
from factorbus.proto.stamps import NO_STAMP

VECTORS = Path(__file__).parents[2] / "proto" / "vectors"
MAKE = runpy.run_path(str(VECTORS / "make.py"))
GOLDEN: dict[str, bytes] = MAKE["vectors"]()
INTERESTS = ("ask_interest", "interest_answer", "interest_delta")

ENCODERS: dict[str, Callable[[Any], bytes]] = {
    "insert": codec.encode_insert,
    "accepted": codec.encode_accepted,
    "estimate": codec.encode_estimate,
    "delta": codec.encode_delta,
    "graph": codec.encode_graph,
    "chi2": codec.encode_chi2,
    "job_done": codec.encode_job_done,
    "job": codec.encode_job,
    "optimum": codec.encode_optimum,
    "problem": codec.encode_problem,
    "ask_estimate": codec.encode_keys_asked,
    **{name: getattr(interest_codec, f"encode_{name}") for name in INTERESTS},
}
DECODERS: dict[str, Callable[[bytes], Any]] = {
    "insert": codec.decode_insert,
    "accepted": codec.decode_accepted,
    "estimate": codec.decode_estimate,
    "delta": codec.decode_delta,
    "graph": codec.decode_graph,
    "chi2": codec.decode_chi2,
    "job_done": codec.decode_job_done,
    "job": codec.decode_job,
    "optimum": codec.decode_optimum,
    "problem": codec.decode_problem,
    "ask_estimate": codec.decode_keys_asked,
    **{name: getattr(interest_codec, f"decode_{name}") for name in INTERESTS},
    "map": codec.decode_map,
}


def message_of(vector: str) -> str | None:
    """The message that a golden file holds: the longest name it begins with."""
    return max((name for name in ENCODERS if vector.startswith(name)), key=len, default=None)


# ---- golden bytes -------------------------------------------------------------------------------------------------


def test_every_vector_is_in_the_tree_and_no_other() -> None:
    for ending in ("msgpack", "json"):
        files = (*VECTORS.glob(f"*.{ending}"), *VECTORS.glob(f"kinds/*.{ending}"))
        assert {str(file.relative_to(VECTORS).with_suffix("")) for file in files} == set(GOLDEN)


@pytest.mark.parametrize("kind", FACTOR_KINDS.values(), ids=lambda kind: kind.name)
def test_every_kind_has_its_golden_message(kind: FactorKind) -> None:
    (group,) = codec.decode_insert((VECTORS / "kinds" / f"{kind.name}.msgpack").read_bytes()).batch.factors
    assert (group.kind, tuple(group.measured[0].tolist())) == (kind.name, kind.example)


@pytest.mark.parametrize("name", GOLDEN)
def test_the_bytes_of_a_message_never_change(name: str) -> None:
    assert GOLDEN[name] == (VECTORS / f"{name}.msgpack").read_bytes()


@pytest.mark.parametrize("name", GOLDEN)
def test_the_description_says_what_is_in_the_bytes(name: str) -> None:
    description = json.loads((VECTORS / f"{name}.json").read_text())
    assert msgpack.packb(from_description(description)) == (VECTORS / f"{name}.msgpack").read_bytes()


WITHOUT_REPORT = "accepted_without_report"


def test_an_answer_without_a_report_is_read_too() -> None:
    assert codec.decode_accepted(GOLDEN[WITHOUT_REPORT]) == Accepted(1, 7, 1, 0, 1)


@pytest.mark.parametrize("name", [name for name in GOLDEN if message_of(name) and name != WITHOUT_REPORT])
def test_decoding_and_encoding_gives_the_golden_bytes_again(name: str) -> None:
    message = message_of(name)
    assert message is not None
    assert ENCODERS[message](DECODERS[message](GOLDEN[name])) == GOLDEN[name]


def test_every_kind_has_a_golden_message() -> None:
    batches = [codec.decode_insert(data).batch for name, data in GOLDEN.items() if name.startswith("insert")]
    assert {group.kind for batch in batches for group in batch.variables} == set(VARIABLE_KINDS)
    kinds = {group.kind for batch in batches for group in batch.factors}
    families = [FACTOR_KINDS[kind] for kind in kinds - set(FACTOR_KINDS.keys())]
    assert kinds - {kind.name for kind in families} == set(FACTOR_KINDS.keys())
    assert all(kind.is_linear or kind.own or kind.imu for kind in families)
    assert {kind.name for kind in families if kind.imu} >= {"imu_2_mount", "imu_preintegrated_mount_gravity"}
    assert {len(kind.connects) for kind in families if kind.is_linear} == {1, 2, 3, 4}


def from_description(content: Any) -> Any:
    """What a client in another language does with a .json."""
    if isinstance(content, dict):
        match content:
            case {"i64": numbers}:
                return np.array(numbers, "<i8").tobytes()
            case {"f64": numbers}:
                return np.array(numbers, "<f8").tobytes()
            case {"u8": numbers}:
                return bytes(numbers)
            case {"msgpack": inner}:
                return msgpack.packb(from_description(inner))
        return {key: from_description(value) for key, value in content.items()}
    return [from_description(item) for item in content] if isinstance(content, list) else content


# ---- round trips --------------------------------------------------------------------------------------------------

NUMBERS = st.integers(0, 2**63 - 1)
DOUBLES = st.floats(allow_nan=True, allow_infinity=True, width=64)
NAMES = st.text(max_size=12)
REPORTS = st.dictionaries(NAMES, st.one_of(st.floats(allow_nan=False), st.integers(-5, 5), NAMES), max_size=5)


@st.composite
def variables(draw: st.DrawFn, valued: bool = False) -> Variables:
    kind = VARIABLE_KINDS[draw(st.sampled_from(sorted(VARIABLE_KINDS)))]
    count = draw(st.integers(0, 4))
    keys = draw(arrays("<i8", (count,), elements=st.integers(-(2**63), 2**63 - 1)))
    has_values = valued or draw(st.booleans())
    values = draw(arrays("<f8", (count, kind.size), elements=DOUBLES)) if has_values else None
    stamps = draw(arrays("<i8", (count,), elements=st.integers(-(2**63), 2**63 - 1))) if draw(st.booleans()) else None
    return Variables(kind.name, keys, values, draw(st.booleans()), stamps)


@st.composite
def factors(draw: st.DrawFn) -> Factors:
    kind = FACTOR_KINDS[draw(st.sampled_from(sorted(FACTOR_KINDS)))]
    count = draw(st.integers(0, 4))
    return Factors(
        kind.name,
        draw(arrays("<i8", (count, len(kind.connects)), elements=st.integers(0, 2**62))),
        draw(arrays("<f8", (count, kind.size), elements=DOUBLES)),
        draw(arrays("<f8", (count, kind.information_size), elements=DOUBLES)),
    )


@st.composite
def changes(draw: st.DrawFn) -> Change:
    name = draw(st.sampled_from(sorted(CHANGES)))
    of, count = CHANGES[name], draw(st.integers(0, 3))
    named = draw(arrays("<i8", (count,), elements=st.integers(0, 2**62)))
    numbers = arrays("<f8", (count,), elements=DOUBLES)
    if of.names == "keys":
        if of.numbers:
            kind = VARIABLE_KINDS[draw(st.sampled_from(sorted(VARIABLE_KINDS)))]
            values = draw(arrays("<f8", (count, kind.size), elements=DOUBLES))
            return Change(name, keys=named, kind=kind.name, values=values)
        return Change(name, keys=named, alone=name == "remove_variables" and draw(st.booleans()))
    if of.numbers == "weight":
        return Change(name, named, weight=draw(numbers))
    if of.numbers and draw(st.booleans()):
        return Change(name, named, loss=draw(st.sampled_from(LOSSES)), scale=draw(numbers))
    return Change(name, named)


BATCHES = st.builds(Batch, st.lists(variables(), max_size=3).map(tuple), st.lists(factors(), max_size=3).map(tuple))
VALUES = st.lists(variables(valued=True), max_size=3).map(tuple)
MESSAGES = {
    "insert": st.builds(
        Insert,
        st.integers(1, 2**63 - 1),
        BATCHES,
        st.booleans(),
        NUMBERS,
        convert_below=st.floats(0.0, allow_infinity=False).map(lambda below: below or 0.0),  # 0 is as good as none
        changes=st.lists(changes(), max_size=3).map(tuple),
    ),
    "accepted": st.builds(Accepted, NUMBERS, NUMBERS, NUMBERS, NUMBERS, NUMBERS, REPORTS),
    "estimate": st.builds(Estimate, NUMBERS, NUMBERS, VALUES),
    "delta": st.builds(Delta, NUMBERS, NUMBERS, NUMBERS, VALUES, REPORTS),
    "graph": st.builds(MapGraph, NUMBERS, NUMBERS, BATCHES),
    "chi2": st.builds(
        Chi2, NUMBERS, NUMBERS, st.floats(), st.floats(), NAMES, st.floats(), NAMES, batch_converged=st.booleans()
    ),
    "job": st.builds(Job, NAMES, NAMES, st.binary(max_size=40)),
    "job_done": st.builds(JobDone, NAMES, NAMES, st.binary(max_size=40), st.floats()),
    "optimum": st.builds(Optimum, st.floats(), NUMBERS, VALUES, NAMES, st.booleans()),
}


@pytest.mark.parametrize("name", MESSAGES)
@settings(max_examples=40)
@given(data=st.data())
def test_a_message_survives_the_wire_bit_for_bit(name: str, data: st.DataObject) -> None:
    message = data.draw(MESSAGES[name])
    sent = ENCODERS[name](message)
    arrived = DECODERS[name](sent)
    assert repr(arrived) == repr(message)
    assert ENCODERS[name](arrived) == sent  # the repr of an array is rounded, its bytes are not


@pytest.mark.parametrize("converged", [True, False])
def test_whether_an_optimum_has_converged_arrives_and_is_told_only_where_it_has_not(converged: bool) -> None:
    optimum = codec.encode_optimum(Optimum(1.0, 2, (), "odometry", converged))
    chi2 = codec.encode_chi2(Chi2(7, 3, 2.0, 1.0, "w1", 0.5, "odometry", batch_converged=converged))
    assert codec.decode_optimum(optimum).converged is converged
    assert codec.decode_chi2(chi2).batch_converged is converged
    told = codec.decode_map(optimum).get("converged", "absent"), codec.decode_map(chi2).get("batch_converged", "absent")
    assert told == (("absent", "absent") if converged else (False, False))


@pytest.mark.parametrize("wrong", ["no", 0, 1, None, 0.0])
def test_whether_an_optimum_has_converged_is_a_bool(wrong: Any) -> None:
    optimum = codec.decode_map(codec.encode_optimum(Optimum(1.0, 2, ()))) | {"converged": wrong}
    chi2 = codec.decode_map(codec.encode_chi2(Chi2(7, 3, 2.0, 1.0, "w1", 0.5))) | {"batch_converged": wrong}
    with pytest.raises(BadMessage, match="converged"):
        codec.decode_optimum(msgpack.packb(optimum))
    with pytest.raises(BadMessage, match="batch_converged"):
        codec.decode_chi2(msgpack.packb(chi2))


@pytest.mark.parametrize("group", [{}, {"stamps": None}])
def test_no_stamps_and_nil_are_the_same(group: dict[str, Any]) -> None:
    content = {"kind": "se2", "keys": b"\0" * 8, "values": b"\0" * 24} | group
    made = codec.decode_insert(msgpack.packb({"sequence": 1, "variables": [content]})).batch.variables[0]
    assert made.stamps is None


def test_stamps_keep_every_digit() -> None:
    stamps = codec.decode_delta(GOLDEN["delta_stamps"]).variables[0].stamps
    assert stamps is not None
    assert stamps.tolist() == [1_403_636_579_763_555_584, NO_STAMP]


def test_arrays_arrive_as_read_only_views() -> None:
    group = codec.decode_estimate(GOLDEN["estimate"]).variables[0]
    assert not group.keys.flags.writeable
    assert not group.values.flags.owndata
    with pytest.raises(ValueError, match="read-only"):
        group.values[0, 0] = 1.0


def test_columns_of_any_layout_are_sent_in_row_order() -> None:
    values = np.asfortranarray(np.arange(12.0).reshape(4, 3))[::2]
    sent = codec.encode_estimate(Estimate(1, 1, (Variables("se2", np.array([1, 2], np.int32), values),)))
    arrived = codec.decode_estimate(sent).variables[0]
    assert arrived.keys.tolist() == [1, 2]
    assert arrived.values.tolist() == [[0, 1, 2], [6, 7, 8]]


def test_a_problem_arrives_with_its_code_and_detail() -> None:
    refused = codec.decode_problem(codec.encode_problem(UnknownMap("attic")))
    assert isinstance(refused, Refused)
    assert (refused.code, refused.detail) == ("unknown_map", {"map": "attic"})
    assert str(refused) == f"{UnknownMap('attic').message} [unknown_map]"


def test_what_messagepack_has_no_type_for_is_told_all_the_same() -> None:
    odd = Problem("odd", count=np.int64(3), path=Path("/a"))
    assert codec.decode_problem(codec.encode_problem(odd)).detail == {"count": 3, "path": "/a"}
    assert codec.decode_map(codec.encode_map({"x": np.float64(0.5)})) == {"x": 0.5}


def test_no_bytes_are_an_empty_question() -> None:
    assert codec.decode_map(b"") == {}
    assert codec.decode_keys_asked(b"") is None


# ---- fuzz: whatever arrives, BadMessage or TooLarge, and soon -----------------------------------------------------


@pytest.mark.parametrize("decoder", DECODERS)
@settings(max_examples=60)
@given(data=st.binary(max_size=200))
def test_no_bytes_do_harm(decoder: str, data: bytes) -> None:
    decodes_or_refuses(DECODERS[decoder], data)


@pytest.mark.parametrize(
    "name", [*sorted(set(GOLDEN) & set(DECODERS)), "insert_all_kinds", "insert_observations", "insert_points"]
)
@settings(max_examples=150)
@given(data=st.data())
def test_no_mutation_of_a_valid_message_does_harm(name: str, data: st.DataObject) -> None:
    original = GOLDEN[name]
    mutant = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(mutant) - 1))
        match data.draw(st.sampled_from(("set", "cut", "insert", "end"))):
            case "set":
                mutant[at] = data.draw(st.integers(0, 255))
            case "cut":
                del mutant[at : at + data.draw(st.integers(1, 9))]
            case "insert":
                mutant[at:at] = data.draw(st.binary(min_size=1, max_size=9))
            case "end":
                del mutant[max(at, 1) :]
        assume(mutant)
    decodes_or_refuses(DECODERS[message_of(name) or "map"], bytes(mutant))


@settings(max_examples=100)
@given(
    st.recursive(
        st.one_of(
            st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), NAMES, st.binary(max_size=30)
        ),
        lambda inner: st.one_of(
            st.lists(inner, max_size=4),
            st.dictionaries(
                st.sampled_from(
                    ("sequence", "epoch", "variables", "factors", "kind", "keys", "values", "report", "chi2")
                ),
                inner,
                max_size=5,
            ),
        ),
        max_leaves=20,
    )
)
def test_no_structure_does_harm(content: Any) -> None:
    data = msgpack.packb(content)
    for decode in DECODERS.values():
        decodes_or_refuses(decode, data)


def decodes_or_refuses(decode: Callable[[bytes], Any], data: bytes) -> None:
    try:
        decode(data)
    except (BadMessage, TooLarge) as problem:
        codec.decode_problem(codec.encode_problem(problem))  # and it can be told


def test_a_documented_field_of_a_report_can_always_be_asked_for() -> None:
    """Services tell what their steps have; a reader need not know which."""
    page = (Path(__file__).parents[2] / "proto" / "README.md").read_text(encoding="utf-8")
    table = page[page.index("**report** is open") : page.index("`vectors/` has each of these")]
    named = [
        name
        for line in table.splitlines()
        if line.startswith("| `")
        for name in re.findall(r"`(\w+)`", line[: line.index("|", 2)])
    ]
    assert {"mode", "because", "chi2", "converged", "step_ms", "solver_ms", "removed_factors"} <= set(named)
    accepted = codec.decode_accepted(
        msgpack.packb({"sequence": 1, "epoch": 1, "revision": 1, "first_factor": 0, "applied": 1})
    )
    for name in named:
        accepted.report[name]
        assert name not in accepted.report
    with pytest.raises(KeyError):
        accepted.report["chi"]
