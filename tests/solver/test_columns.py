"""A batch goes in the same whatever sort of arrays it has, and of several problems the first is reported."""

import pickle
from collections.abc import Callable

import numpy as np
import pytest
from naive.random_graphs import random_steps
from naive.solver_parts import graph_in

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Solver, errors
from factorbus.solver.kernels.model import layout as at

EYE3 = np.array([[1.0, 0, 0, 1, 0, 1]])


def rows(solver: Solver) -> list[bytes]:
    """The graph."""
    graph = graph_in(solver)
    variables, factors, values, payload, *_ = graph.counts.tolist()
    used = graph.keys[:variables], graph.stamps[:variables], graph.var[:variables], graph.fac[:factors, : at.F_AT + 1]
    return [array.tobytes() for array in (graph.counts, *used, graph.values[:values], graph.payload[:payload])]


def read_only(array: np.ndarray) -> np.ndarray:
    return np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape)


def unaligned(array: np.ndarray) -> np.ndarray:
    return np.ndarray(array.shape, array.dtype, b"x" + array.tobytes(), offset=1)


def with_gaps(array: np.ndarray) -> np.ndarray:
    wide = np.zeros((*array.shape, 2), array.dtype)
    wide[..., 0] = array
    return wide[..., 0]


def of_another_process(array: np.ndarray) -> np.ndarray:
    came = pickle.loads(pickle.dumps(array))
    assert came.dtype is not array.dtype, "its types are the same objects"
    return came


@pytest.mark.parametrize("made", [read_only, unaligned, with_gaps, np.asfortranarray, of_another_process])
@pytest.mark.parametrize("seed", range(3))
def test_arrays_of_any_sort(made: Callable[[np.ndarray], np.ndarray], seed: int) -> None:
    plain, other = Solver(), Solver()
    for batch in random_steps(seed):
        copied = Batch(*(tuple(with_arrays(group, made) for group in groups) for groups in batch))  # type: ignore[arg-type]
        assert plain.stage(batch) == other.stage(copied)
        assert rows(plain) == rows(other)
        plain.step()
        other.step()
    assert rows(plain) == rows(other)


def with_arrays(group: Variables | Factors, made: Callable[[np.ndarray], np.ndarray]) -> Variables | Factors:
    return group._replace(**{n: made(a) for n, a in group._asdict().items() if isinstance(a, np.ndarray)})


def poses(*keys: int) -> Variables:
    return Variables("se2", np.array(keys), np.zeros((len(keys), 3)))


def edge(i: int, j: int, **more: object) -> Factors:
    return Factors("between_se2", np.array([[i, j]]), np.zeros((1, 3)), EYE3)._replace(**more)


UNKNOWN = Variables("se4", np.array([3]))
WRONG = {
    "a row before a shape": ("duplicate_variable", Batch((poses(1), poses(2)._replace(values=np.zeros((1, 2)))))),
    "a shape before a row": ("bad_shape", Batch((poses(2)._replace(values=np.zeros((1, 2))), poses(1)))),
    "a kind before a row": ("unknown_kind", Batch((UNKNOWN, poses(1)))),
    "variables before factors": ("duplicate_variable", Batch((poses(1),), (edge(1, 2, measured=np.zeros((1, 4))),))),
    "a factor before a shape": ("unknown_variable", Batch((), (edge(1, 9), edge(1, 2, measured=np.zeros((1, 4)))))),
    "a shape before a factor": ("bad_shape", Batch((), (edge(1, 2, measured=np.zeros((1, 4))), edge(1, 9)))),
    "a shape before what has no value": (
        "bad_shape", Batch((poses(7)._replace(values=None),), (edge(1, 2, information=np.zeros((1, 5))),)),
    ),
    "a scale before a loss": (
        "bad_loss", Batch((), (edge(1, 2, loss="huber", scale=np.zeros(1)), edge(1, 9, loss="welsch", scale=None))),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_of_two_problems_the_first_is_told(name: str) -> None:
    code, batch = WRONG[name]
    solver = Solver()
    solver.stage(Batch((poses(1, 2),)))
    before = rows(solver)
    with pytest.raises(errors.SolverError) as caught:
        solver.stage(batch)
    assert caught.value.code == code
    assert rows(solver) == before
