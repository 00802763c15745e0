"""The compiled writer of the messages of a step against the codec: the same bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive.random_graphs import random_steps

from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch, Delta, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.service.kernels.write import write_messages
from factorbus.service.solving.messages import StepMessages
from factorbus.solver import Options, Solver

seeds = st.integers(0, 2**32 - 1)
# Either side of every change of form.
integers = st.sampled_from([0, 1, 127, 128, 255, 256, 65_535, 65_536, 2**32 - 1, 2**32, 2**62, 2**63 - 1])


@settings(max_examples=25, deadline=None)
@given(seeds, st.lists(st.tuples(integers, integers), max_size=4), integers, integers.filter(bool), integers)
def test_answers_and_delta_are_the_bytes_of_the_codec(
    seed: int, answers: list[tuple[int, int]], epoch: int, revision: int, previous: int
) -> None:
    solver, messages = Solver(Options(mode=("inc-l", "bayes-tree")[seed % 2])), StepMessages()
    for batch in random_steps(seed % 10_000, steps=5):
        solver.stage(batch)
        reported = solver.step().as_dict() | {"solver_ms": 0.25}
        written = messages.write(answers, (epoch, revision, previous), reported, *solver.pick_changed())
        told = tuple(Variables(*group) for group in solver.changed())
        wanted = [
            codec.encode_accepted(Accepted(sequence, epoch, revision, first_factor, len(answers), reported))
            for sequence, first_factor in answers
        ]
        delta = codec.encode_delta(Delta(epoch, revision, previous, told, reported))
        assert written == [*wanted, delta]
        assert messages.write_answers(answers, epoch, revision, reported) == wanted
        assert messages.write_delta((epoch, revision, previous), reported, *solver.pick_changed()) == delta


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
        out, ends = np.full(room + 64, 0xAA, np.uint8), np.zeros(2, np.int64)
        answers, step = np.array([[1, 4]]), np.array([2, 3, 2])
        size = write_messages(answers, step, codec.report_encoder()({}), changed, graph.array_table, out[:room], ends)
        assert len(wanted) <= size <= len(wanted) + 512
        assert (ends[1] == len(wanted)) == (size <= room)
        assert out[: ends[1]].tobytes() == wanted[: ends[1]]
        assert (out[room:] == 0xAA).all(), "nothing is written past the end"
    assert b"".join(StepMessages().write([(1, 4)], (2, 3, 2), {}, changed, graph)) == wanted
