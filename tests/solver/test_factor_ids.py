"""A factor keeps its id, whatever comes, is removed in place, is refused, or is asked about."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive.solver_parts import graph_in

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.solver import Solver
from factorbus.solver.changing import try_change
from factorbus.solver.divergence import copied
from factorbus.solver.errors import SolverError

POINTS = np.arange(1, 5)
THREE = "three(a:point2,b:point2,c:point2,z:1)=subtract(norm(add(a,add(b,c))),z)"
Known = dict[int, tuple[str, tuple[int, ...], float]]  # by id: kind, variables, first number


def prior(key: int, x: float) -> Factors:
    return Factors("prior_point2", np.array([[key]]), np.array([[x, 0.0]]), np.array([[1.0, 0.0, 1.0]]))


def of_three(x: float, own: bool) -> Factors:
    """A factor of three variables, which has several rows."""
    if own:
        return Factors(THREE, np.array([[1, 2, 3]]), np.array([[x]]), np.array([[1.0]]))
    numbers = np.array([[x, *[0.5] * 6, *[0.0] * 6]])  # residual, Jacobian, linearization point
    return Factors("linear_1_point2_point2_point2", np.array([[1, 2, 3]]), numbers, np.array([[1.0]]))


def factors_of(solver: Solver) -> Known:
    known: Known = {}
    for group in solver.graph()[1]:
        assert group.ids is not None
        for row, i in enumerate(group.ids.tolist()):
            known[i] = group.kind, tuple(group.keys[row].tolist()), float(group.measured[row][0])
    return known


def begun() -> tuple[Solver, Known]:
    solver = Solver()
    held = tuple(prior(int(key), float(key)) for key in POINTS)
    solver.stage(Batch((Variables("point2", POINTS, np.eye(4)[:, :2].copy()),), held))
    solver.step()
    return solver, factors_of(solver)


class Drive:
    """A solver, and what it has to know: operations on both."""

    def __init__(self) -> None:
        self.solver, self.known = begun()
        self.next_id, self.x = len(self.known), 10.0

    def add(self, *groups: Factors) -> None:
        first = self.solver.stage(Batch((), groups))
        self.solver.step()
        assert first == self.next_id
        for group in groups:
            keys = tuple(group.keys[0].tolist())
            self.known[self.next_id] = group.kind, keys, float(group.measured[0][0])
            self.next_id += 1

    def plain(self) -> None:
        self.x += 1.0
        self.add(prior(1 + int(self.x) % 4, self.x))

    def three(self) -> None:
        self.x += 1.0
        self.add(of_three(self.x, int(self.x) % 2 == 0), prior(2, self.x))

    def remove_three(self) -> None:
        self._remove([i for i, (kind, *_) in self.known.items() if kind != "prior_point2"])

    def remove_one(self) -> None:
        self._remove([i for i in self.known if i >= len(POINTS)][:1])

    def _remove(self, ids: list[int]) -> None:
        if ids and try_change(self.solver, [Change("remove_factors", factors=np.array(ids))]) is not None:
            for i in ids:
                del self.known[i]

    def fail_to_remove(self) -> None:
        """In the same change a new variable comes that nothing holds, so all of it is taken back."""
        later = [i for i in self.known if i >= len(POINTS)]
        free = Batch((Variables("point2", np.array([99]), np.zeros((1, 2))),), (of_three(1.0, True),))
        if later:
            change = [Change("remove_factors", factors=np.array(later[-1:]))]
            assert try_change(self.solver, change, free) is None

    def refuse(self) -> None:
        with pytest.raises(SolverError):
            self.solver.stage(Batch((), (of_three(2.0, False), prior(98, 0.0))))

    def refuse_in_step(self) -> None:
        self.solver.stage(Batch((Variables("point2", np.array([99]), np.zeros((1, 2))),), (of_three(3.0, True),)))
        with pytest.raises(SolverError):
            self.solver.step()

    def copy(self) -> None:
        self.solver = copied(self.solver)


OPERATIONS: list[Callable[[Drive], None]] = [
    Drive.plain,
    Drive.three,
    Drive.remove_three,
    Drive.remove_one,
    Drive.fail_to_remove,
    Drive.refuse,
    Drive.refuse_in_step,
    Drive.copy,
]


@given(st.lists(st.sampled_from(OPERATIONS), min_size=3, max_size=12))
@settings(max_examples=60, deadline=None)
def test_ids_stay(operations: list[Callable[[Drive], None]]) -> None:
    drive = Drive()
    for operation in operations:
        operation(drive)
        assert factors_of(drive.solver) == drive.known
        assert graph_in(drive.solver).next_id == drive.next_id


@pytest.mark.parametrize("refused", [Drive.refuse, Drive.refuse_in_step, Drive.copy])
def test_after_the_only_factor_of_three_was_removed_a_refusal_renames_none(refused: Callable[[Drive], None]) -> None:
    """Once they were put back to what they were before any had several rows: "remove 6" then removed another one."""
    drive = Drive()
    for operation in (Drive.three, Drive.plain, Drive.remove_three, refused):
        operation(drive)
    assert factors_of(drive.solver) == drive.known


def test_what_is_refused_leaves_the_list_of_ids_as_it_was() -> None:
    """The first factor of three lists all ids, and its refusal takes the list back."""
    drive = Drive()
    graph = graph_in(drive.solver)
    before = graph.ids.tobytes(), graph.id_shift
    drive.refuse()
    drive.refuse_in_step()
    drive.plain()
    drive.fail_to_remove()
    assert (graph.ids.tobytes(), graph.id_shift) == before
