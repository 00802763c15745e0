"""The compiled readers and writers against the codec: the same content, the same bytes, and nothing that it refuses."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive.random_graphs import random_steps

from factorbus.proto import codec
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.limits import REQUEST_LIMITS, MessageLimits
from factorbus.proto.messages import Accepted, Batch, Delta, Factors, Insert, Variables
from factorbus.proto.problems import Problem
from factorbus.proto.stamps import NO_STAMP
from factorbus.service.core.events import Arrived, ParsedInsert
from factorbus.service.kernels.words import LETTERS, LONGEST, WORDS
from factorbus.service.kernels.write import write_messages
from factorbus.service.solving.arrival import message_digest, read_insert, try_locate
from factorbus.solver import Options, Solver, SolverError
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE, LENS_AT
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.model import layout as at

MANY = settings(max_examples=400, deadline=None)
seeds = st.integers(0, 2**32 - 1)
# Either side of every change of form.
integers = st.sampled_from([0, 1, 127, 128, 255, 256, 65_535, 65_536, 2**32 - 1, 2**32, 2**62, 2**63 - 1])


def content_of(located: ParsedInsert) -> tuple[list[Any], list[Any]]:
    """Kinds and columns, bit for bit, at the places that were found."""

    def column(row: np.ndarray, offset: int, numbers: int) -> bytes | None:
        size = 8 * int(row[at.G_COUNT]) * numbers
        return None if offset < 0 else located.message[offset : offset + size]

    variables, factors = [], []
    for row in located.groups:
        if row[at.G_KIND] == at.END:
            break
        keys = column(row, row[at.G_KEYS], row[at.G_ARITY])
        numbers = column(row, row[at.G_NUMBERS], row[at.G_SIZE])
        if row[at.G_FACTORS]:
            information = column(row, row[at.G_INFORMATION], row[at.G_TRIANGLE])
            factors.append((FACTOR_KIND_OF_CODE[int(row[at.G_KIND])].name, keys, numbers, information))
        else:
            stamps, kind = column(row, row[at.G_STAMPS], 1), VARIABLE_KIND_OF_CODE[int(row[at.G_KIND])].name
            variables.append((kind, keys, numbers, bool(row[at.G_FIXED]), stamps))
    return variables, factors


def bits(column: np.ndarray | None) -> bytes | None:
    return None if column is None else column.tobytes()


def content(batch: Batch) -> tuple[list[Any], list[Any]]:
    """The same of a batch."""
    variables = [(g.kind, g.keys.tobytes(), bits(g.values), g.fixed, bits(g.stamps)) for g in batch.variables]
    return variables, [(g.kind, g.keys.tobytes(), g.measured.tobytes(), g.information.tobytes()) for g in batch.factors]


# What cameras see goes the usual way: their lenses are looked at there.
QUICK = [name for name in FACTOR_KINDS if name not in LENS_AT]


def check_agrees(message: bytes) -> bool:
    """Whether it was located; then the codec accepts it, with the same content."""
    located = try_locate(message, REQUEST_LIMITS)
    if located is None:
        return False
    insert = codec.decode_insert(message)
    assert located[:2] == (insert.sequence, insert.epoch)
    assert located[2] == message_digest(message)
    assert located[3].settle == insert.settle
    assert content_of(located[3]) == content(insert.batch)
    return True


def random_batch(rng: np.random.Generator) -> Batch:
    """Groups of any kinds and sizes, with any bits in their columns."""

    def numbers(*shape: int) -> np.ndarray:
        return rng.integers(-(2**63), 2**63, shape).view(np.float64)

    variables, factors = [], []
    for kind in rng.choice(list(VARIABLE_KINDS), rng.integers(0, 5)).tolist():
        n = int(rng.integers(0, 6))
        values = numbers(n, VARIABLE_KINDS[kind].size) if rng.random() < 0.7 else None
        stamps = rng.integers(-(2**63), 2**63, n) if rng.random() < 0.5 else None
        variables.append(Variables(kind, rng.integers(-(2**63), 2**63, n), values, bool(rng.random() < 0.3), stamps))
    for name in rng.choice(QUICK, rng.integers(0, 5)).tolist():
        kind, n = FACTOR_KINDS[name], int(rng.integers(0, 20))
        ends = rng.integers(-(2**63), 2**63, (n, len(kind.connects)))
        factors.append(Factors(name, ends, numbers(n, kind.size), numbers(n, kind.information_size)))
    return Batch(tuple(variables), tuple(factors))


@MANY
@given(seeds, integers, integers, st.booleans())
def test_every_short_insert_of_our_encoder_is_read_where_it_lies(
    seed: int, sequence: int, epoch: int, settle: bool
) -> None:
    batch = random_batch(np.random.default_rng(seed))
    message = codec.encode_insert(Insert(max(sequence, 1), batch, settle, epoch))
    assert check_agrees(message) or len(message) > 16 << 10


# ---- what is not as usual --------------------------------------------------------------------------------------


def shuffled(content: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    return {name: content[name] for name in rng.permutation(list(content)).tolist()}


@MANY
@given(seeds)
def test_fields_may_come_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    insert = msgpack.unpackb(codec.encode_insert(Insert(3, random_batch(rng), bool(seed % 2), 4)))
    for groups in ("variables", "factors"):
        insert[groups] = [shuffled(group, rng) for group in insert[groups]]
    assert check_agrees(msgpack.packb(shuffled(insert, rng)))


OTHERS = [0, 1, -1, 2**63, 2**64 - 1, 1.5, True, None, "se2", "keys", "x" * 40, b"", b"12345678", bytes(24), [], {}]


@MANY
@given(seeds)
def test_what_is_wrong_or_unusual_is_left_to_the_codec(seed: int) -> None:
    """Fields exchanged, missing, doubled or unknown; values of other types and lengths; at any level."""
    rng = np.random.default_rng(seed)
    insert = msgpack.unpackb(codec.encode_insert(Insert(3, random_batch(rng), False, 4)))
    for _ in range(rng.integers(1, 4)):
        level = rng.choice(np.array([insert, *insert.get("variables", ()), *insert.get("factors", ())], object))
        if not isinstance(level, dict) or not level:
            continue
        name = rng.choice(list(level))
        other = OTHERS[rng.integers(len(OTHERS))]
        match rng.integers(4):
            case 0:
                del level[name]
            case 1:
                level[str(rng.choice(["sequence", "values", "measured", "fixed", "settle", "stamps", "colour"]))] = (
                    other
                )
            case 2 if isinstance(level[name], bytes):
                level[name] = level[name][: rng.integers(0, len(level[name]) + 1)] + bytes(rng.integers(0, 17))
            case _ if name not in ("variables", "factors"):
                level[name] = other
        if not all(isinstance(insert.get(groups, []), list) for groups in ("variables", "factors")):
            break
    check_agrees(msgpack.packb(insert, use_single_float=bool(seed % 2)))


@MANY
@given(seeds)
def test_bytes_that_were_damaged_are_never_taken_for_something_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    message = bytearray(codec.encode_insert(Insert(3, random_batch(rng), True, 2**40)))
    match rng.integers(4):
        case 0:
            del message[rng.integers(len(message)) :]
        case 1:
            message += bytes(rng.integers(1, 9))
        case _:
            for place in rng.integers(0, len(message), rng.integers(1, 4)):
                message[place] = rng.integers(256)
    check_agrees(bytes(message))


@settings(max_examples=1000, deadline=None)
@given(st.binary(max_size=64))
def test_any_bytes_at_all(message: bytes) -> None:
    check_agrees(message)


UNUSUAL = {
    "no sequence": msgpack.packb({"epoch": 1}),
    "sequence 0": msgpack.packb({"sequence": 0}),
    "sequence beyond": msgpack.packb({"sequence": 2**63}),
    "negative epoch": msgpack.packb({"sequence": 1, "epoch": -1}),
    "a field twice": b"\x82\xa8sequence\x01\xa8sequence\x02",
    "kind twice": b"\x82\xa8sequence\x01\xa9variables\x91\x83\xa4kind\xa3se2\xa4keys\xc4\x00\xa4kind\xa6point2",
    "an unknown field": msgpack.packb({"sequence": 1, "colour": "red"}),
    "a long map": b"\xde\x00\x01\xa8sequence\x01",
    "a long array": b"\x82\xa8sequence\x01\xa9variables\xdc\x00\x00",
    "a long string": b"\x81\xd9\x08sequence\x01",
    "a signed integer": b"\x81\xa8sequence\xd0\x01",
    "an unknown kind": msgpack.packb({"sequence": 1, "variables": [{"kind": "se4", "keys": b""}]}),
    "a factor's kind for variables": msgpack.packb({"sequence": 1, "variables": [{"kind": "prior_se2", "keys": b""}]}),
    "factors without keys": msgpack.packb(
        {"sequence": 1, "factors": [{"kind": "prior_se2", "measured": b"", "information": b""}]}
    ),
    "factors without information": msgpack.packb(
        {"sequence": 1, "factors": [{"kind": "prior_se2", "keys": b"", "measured": b""}]}
    ),
    "nothing": b"",
    "something behind": msgpack.packb({"sequence": 1}) + b"\xc0",
    "stamps of factors": msgpack.packb(
        {
            "sequence": 1,
            "factors": [{"kind": "prior_se2", "keys": b"", "measured": b"", "information": b"", "stamps": b""}],
        }
    ),
    "stamps that are too few": msgpack.packb(
        {"sequence": 1, "variables": [{"kind": "se2", "keys": bytes(16), "stamps": bytes(8)}]}
    ),
    "stamps twice": b"\x82\xa8sequence\x01\xa9variables\x91\x84\xa4kind\xa3se2\xa4keys\xc4\x00" + 2 * b"\xa6stamps\xc0",
    "more groups than usual": msgpack.packb({"sequence": 1, "variables": [{"kind": "se2", "keys": b""}] * 16}),
}


@pytest.mark.parametrize("name", UNUSUAL)
def test_left_to_the_codec(name: str) -> None:
    assert try_locate(UNUSUAL[name], REQUEST_LIMITS) is None


def test_the_limits_of_a_service_hold_for_both() -> None:
    message = codec.encode_insert(Insert(1, Batch((Variables("se2", np.arange(9), np.zeros((9, 3))),))))
    assert try_locate(message, REQUEST_LIMITS)
    tight = (MessageLimits(len(message) - 1, 100, 100), MessageLimits(1 << 20, 8, 100), MessageLimits(1 << 20, 100, 0))
    for limits in tight:
        assert try_locate(message, limits) is None


def test_an_arrival_is_the_same_either_way() -> None:
    message = codec.encode_insert(Insert(7, Batch(), True, 9))
    quick = read_insert("asker", "robot", message, REQUEST_LIMITS, 1.5)
    usual = read_insert("asker", "robot", message, MessageLimits(1 << 20, 0, 0), 1.5)
    assert isinstance(quick, Arrived)
    assert isinstance(usual, Arrived)
    assert isinstance(quick.content, ParsedInsert)
    assert isinstance(usual.content, Insert)
    assert quick._replace(content=usual.content) == usual


@MANY
@given(st.binary(max_size=40), seeds)
def test_a_digest_tells_messages_apart(message: bytes, seed: int) -> None:
    others = {message + b"\0", message[:-1], b"\0" + message, message[::-1]} - {message}
    for k in range(8 * len(message)):
        changed = bytearray(message)
        changed[k // 8] ^= 1 << k % 8
        others.add(bytes(changed))
    assert len({message_digest(other) for other in (message, *others)}) == len(others) + 1
    assert 0 <= message_digest(message) < 2**63


def test_the_digest_of_a_message_never_changes() -> None:
    wanted = [7775671951334427883, 6423431365456653165, 9160638965743508112]
    assert [message_digest(message) for message in (b"", b"factorbus", bytes(range(256)))] == wanted


# ---- into the solver -------------------------------------------------------------------------------------------


def arenas(solver: Solver) -> list[bytes]:
    """All that is in use."""
    graph = solver._graph
    variables, factors, values, payload, columns, *_ = graph.counts.tolist()
    return [
        part.tobytes()
        for part in (
            graph.counts, graph.keys[:variables], graph.var[:variables], graph.dims[:columns], graph.values[:values],
            graph.fac[:factors], graph.payload[:payload], np.flatnonzero(graph.table), graph.table[graph.table > 0],
            graph.stamps[:variables],
        )
    ]  # fmt: skip


def stage_both(quick: Solver, usual: Solver, batch: Batch) -> bool:
    """Stage in two solvers that are alike, once as located columns; whether it was taken so.  They stay alike."""
    message = codec.encode_insert(Insert(1, batch))
    located = try_locate(message, REQUEST_LIMITS)
    if located is None:
        assert max(len(batch.variables), len(batch.factors)) > 15
        return quick.stage(batch) != usual.stage(batch)
    before = arenas(quick)
    first = quick.try_stage(message, located[3].groups)
    if first is None:
        assert arenas(quick) == before, "nothing was done"
    try:
        wanted = usual.stage(batch)
    except SolverError:
        assert first is None
        return False
    if first is None:
        quick.stage(batch)
    else:
        assert first == wanted
    assert arenas(quick) == arenas(usual)
    return first is not None


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_columns_are_staged_where_they_lie_as_from_arrays(seed: int) -> None:
    quick, usual = Solver(), Solver()
    taken = [stage_both(quick, usual, batch) for batch in random_steps(seed % 10_000, steps=12)]
    # The first ones make room.
    assert any(taken)


def damaged(batch: Batch, rng: np.random.Generator) -> Iterator[Batch]:
    """The batch with something wrong in it, in many ways."""
    for n, group in enumerate(batch.factors):
        for bad in (np.nan, np.inf, 0.0, -1.0, 1e150):
            measured, information = group.measured.copy(), group.information.copy()
            measured.flat[rng.integers(measured.size)] = bad
            information.flat[rng.integers(information.size)] = bad
            ends = group.keys.copy()
            ends.flat[rng.integers(ends.size)] = rng.choice([0, 7, *group.keys.flat])
            for change in ({"measured": measured}, {"information": information}, {"keys": ends}):
                yield batch._replace(factors=(*batch.factors[:n], group._replace(**change), *batch.factors[n + 1 :]))
    for n, group in enumerate(batch.variables):
        changes: list[dict[str, Any]] = [{"values": None}, {"keys": np.repeat(group.keys[:1], len(group.keys))}]
        if group.values is not None:
            for bad in (np.nan, -np.inf, 5.0):
                values = group.values.copy()
                values.flat[rng.integers(values.size)] = bad
                changes.append({"values": values})
        for change in changes:
            yield batch._replace(variables=(*batch.variables[:n], group._replace(**change), *batch.variables[n + 1 :]))


@settings(max_examples=8, deadline=None)
@given(seeds)
def test_what_the_solver_refuses_leaves_no_trace(seed: int) -> None:
    *earlier, last = random_steps(seed % 10_000, steps=4)
    quick, usual = Solver(), Solver()
    for batch in earlier:
        stage_both(quick, usual, batch)
    for solver in (quick, usual):
        # Room, so that it is not for want of it that nothing is taken.
        solver._graph.reserve_variables(500, 3500)
        solver._graph.reserve_factors(500, 14000)
    held = quick._graph.mark()
    for bad in damaged(last, np.random.default_rng(seed)):
        stage_both(quick, usual, bad)
        for solver in (quick, usual):
            solver._graph.forget(held)
    assert stage_both(quick, usual, last)


# ---- the answer and the delta ----------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seeds, integers, integers, integers.filter(bool), integers)
def test_answer_and_delta_are_the_bytes_of_the_codec(
    seed: int, sequence: int, epoch: int, revision: int, first_factor: int
) -> None:
    solver, out = Solver(Options(mode=("inc-l", "bayes-tree")[seed % 2])), np.empty(1 << 16, np.uint8)
    for batch in random_steps(seed % 10_000, steps=5):
        solver.stage(batch)
        account = solver.step().as_dict() | {"solver_ms": 0.25}
        changed, graph = solver.pick_changed()
        answer, delta = write_messages(
            sequence, epoch, revision, first_factor, codec.report_encoder()(account), changed, graph.var, graph.keys,
            graph.values, graph.stamps, WORDS, LETTERS, out,
        )  # fmt: skip
        told = tuple(Variables(*group) for group in solver.changed())
        wanted = Accepted(sequence, epoch, revision, first_factor, 1, account)
        assert out[:answer].tobytes() == codec.encode_accepted(wanted)
        assert out[answer : answer + delta].tobytes() == codec.encode_delta(
            Delta(epoch, revision, revision - 1, told, account)
        )


@pytest.mark.parametrize("count", [1, 3, 10, 31, 32, 255, 300, 2000])
@pytest.mark.parametrize("stamped", [False, True])
def test_columns_of_any_length(count: int, stamped: bool) -> None:
    """Each change of form of a bin, and what does not fit."""
    solver = Solver()
    keys, values = np.arange(count), np.random.default_rng(1).normal(size=(count, 7))
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    stamps = np.where(np.arange(count) == count // 2, -7, NO_STAMP) if stamped else None
    solver.stage(Batch((Variables("se3", keys, values, True, stamps),)))
    solver.step()
    changed, graph = solver.pick_changed()
    told = tuple(Variables(*group) for group in solver.changed())
    assert (told[0].stamps is not None) == stamped
    wanted = codec.encode_accepted(Accepted(1, 2, 3, 4, 1)) + codec.encode_delta(Delta(2, 3, 2, told))
    for room in (1 << 20, len(wanted) + 512, len(wanted) - 1, 0):
        out = np.full(room + 64, 0xAA, np.uint8)
        sizes = write_messages(
            1, 2, 3, 4, codec.report_encoder()({}), changed, graph.var, graph.keys, graph.values, graph.stamps, WORDS,
            LETTERS, out[:room],
        )  # fmt: skip
        assert sum(sizes) == (len(wanted) if room > len(wanted) else 0)
        assert out[: sum(sizes)].tobytes() == wanted[: sum(sizes)]
        assert (out[room:] == 0xAA).all(), "nothing is written past the end"


@pytest.mark.parametrize("name", ["insert_sights", "insert_points"])
def test_sights_losses_and_ripening_are_left_to_the_codec(name: str) -> None:
    vectors = Path(__file__).parents[2] / "proto" / "vectors"
    assert not check_agrees((vectors / f"{name}.msgpack").read_bytes())


def test_the_names_of_all_kinds_can_be_read() -> None:
    """A reader gives up at longer ones."""
    assert max(len(name.encode()) for name in (*VARIABLE_KINDS, *FACTOR_KINDS)) <= LONGEST


def test_a_problem_inside_still_uses_up_its_number() -> None:
    message = msgpack.packb({"sequence": 4, "epoch": 2, "factors": [{"kind": "no_such", "keys": b""}]})
    arrived = read_insert("asker", "robot", message, REQUEST_LIMITS, 0.0)
    assert isinstance(arrived, Arrived)
    assert (arrived.sequence, arrived.epoch) == (4, 2)
    assert isinstance(arrived.content, Problem)
