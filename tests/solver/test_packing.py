"""A batch that is packed into bytes goes in as it would have otherwise, bit for bit."""

import pickle

import numpy as np
import pytest
from naive.random_graphs import random_steps

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Solver
from factorbus.solver.graph.packing import Packing
from factorbus.solver.kernels.model import layout as at

APART = np.zeros((2, 6))[:, ::2]
EYE3 = np.array([[1.0, 0, 0, 1, 0, 1]])


class Never(Packing):
    """Packs nothing."""

    def pack(self, batch: object) -> None:
        return None


def rows(solver: Solver) -> list[bytes]:
    """The graph."""
    graph = solver._graph
    variables, factors, values, payload, *_ = graph.counts.tolist()
    used = graph.keys[:variables], graph.stamps[:variables], graph.var[:variables], graph.fac[:factors, : at.F_AT + 1]
    return [array.tobytes() for array in (graph.counts, *used, graph.values[:values], graph.payload[:payload])]


@pytest.mark.parametrize("seed", range(12))
def test_the_same_graph(seed: int) -> None:
    packed, plain = Solver(), Solver()
    plain._staging._packing = Never()
    taken = 0
    for batch in random_steps(seed):
        taken += packed._staging._packing.pack(batch) is not None
        assert packed.stage(batch) == plain.stage(batch)
        assert rows(packed) == rows(plain)
        packed.step()
        plain.step()
    assert taken, "no step was small enough"
    assert rows(packed) == rows(plain)


def edge(measured: np.ndarray, keys: np.ndarray | None = None, **more: object) -> Batch:
    ends = np.array([[1, 2]]) if keys is None else keys
    return Batch((), (Factors("between_se2", ends, measured, EYE3, **more),))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "batch",
    [
        edge(np.zeros((1, 4))),
        edge(np.zeros((2, 3))),
        edge(np.zeros((1, 3), np.float32)),
        edge(np.zeros((1, 3)), np.array([[1, 2]], np.int32)),
        edge(np.zeros((1, 3)), np.array([1, 2])),
        edge([[0.0, 0.0, 0.0]]),  # type: ignore[arg-type]
        Batch((), (Factors("between_se2", np.zeros((2, 2), np.int64), APART, np.repeat(EYE3, 2, axis=0)),)),
        edge(np.zeros((1, 3)), loss="huber", scale=np.ones(1)),
        Batch((Variables("se4", np.array([3])),)),
        Batch((Variables("se2", np.array([3]), np.zeros((1, 2))),)),
        Batch((Variables("se2", np.arange(65)),)),
        Batch((Variables("se2", np.array([3]), stamps=np.array([1, 2])),)),
        Batch((Variables("se2", np.array([3]), stamps=np.array([1.0])),)),  # type: ignore[arg-type]
    ],
)
def test_what_is_not_plain_is_left_to_admission(batch: Batch) -> None:
    assert Packing().pack(batch) is None


def test_what_came_from_another_process_is_packed_too() -> None:
    batch = Batch((Variables("se2", np.array([1, 2]), np.zeros((2, 3))),), edge(np.zeros((1, 3))).factors)
    came = pickle.loads(pickle.dumps(batch))
    packed, wanted = Packing().pack(came), Packing().pack(batch)
    assert came.factors[0].measured.dtype is not batch.factors[0].measured.dtype, "its types are the same objects"
    assert packed is not None
    assert wanted is not None
    assert packed[0] == wanted[0]
    assert (packed[1] == wanted[1]).all()


def test_many_shapes_are_not_remembered_for_ever() -> None:
    packing = Packing()
    for n in range(3000):
        groups = *(Variables("se2", np.array([k])) for k in range(n % 40)), Variables("se2", np.arange(n // 60))
        packing.pack(Batch(groups))
    assert len(packing._known) <= 1024
