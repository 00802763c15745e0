"""A batch goes into the solver from where its columns lie as from arrays, and leaves no trace if it is refused."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive.random_graphs import camera_steps, random_steps
from naive.solver_parts import graph_in

from factorbus.proto import codec
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES, VARIABLE_KINDS
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Factors, Insert, Variables
from factorbus.service.solving.arrival import try_parse
from factorbus.solver import Solver, SolverError
from factorbus.solver.graph.columns import Columns
from factorbus.solver.kernels.graph import group_table as gt

seeds = st.integers(0, 2**32 - 1)


def arenas(solver: Solver) -> list[bytes]:
    """All that is in use."""
    graph = graph_in(solver)
    variables, factors, values, payload, columns, *_ = graph.counts.tolist()
    return [
        part.tobytes()
        for part in (
            graph.counts, graph.keys[:variables], graph.var[:variables], graph.dims[:columns], graph.values[:values],
            graph.fac[:factors], graph.payload[:payload], np.flatnonzero(graph.table), graph.table[graph.table > 0],
            graph.stamps[:variables],
        )
    ]  # fmt: skip


def stage_both(quick: Solver, usual: Solver, batch: Batch, behind: int | None = None) -> str:
    """Stage in two solvers that are alike, once where it lies in a message; the code of the error, empty: it was taken.
    They stay alike.  behind: what stands in the table where nobody has written."""
    message = codec.encode_insert(Insert(1, batch))
    parsed = try_parse(message, REQUEST_LIMITS)
    assert parsed is not None
    before, came, table = arenas(quick), [], parsed[3].groups
    if behind is not None:
        fill_unwritten(table, behind)
    for solver, columns in ((quick, Columns(message, table)), (usual, batch)):
        try:
            came.append(solver.stage(columns))
        except SolverError as problem:
            came.append((problem.code, str(problem)))
    assert came[0] == came[1]
    assert arenas(quick) == arenas(usual)
    if isinstance(came[0], tuple):
        assert arenas(quick) == before, "a trace is left"
        return came[0][0]
    return ""


def fill_unwritten(table: np.ndarray, number: int) -> None:
    """Of the last row only the kind is written, and nothing of those behind it."""
    end = int(np.argmax(table[:, gt.G_KIND] == gt.END))
    table[end, gt.G_FACTORS :] = number
    table[end + 1 :] = number


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_columns_are_staged_where_they_lie_as_from_arrays(seed: int) -> None:
    quick, usual = Solver(), Solver()
    assert [stage_both(quick, usual, batch) for batch in random_steps(seed % 10_000, steps=12)] == [""] * 12


@pytest.mark.parametrize("seed", range(4))
def test_what_cameras_see_and_losses_are_staged_where_they_lie(seed: int) -> None:
    quick, usual = Solver(), Solver()
    batches = [*camera_steps(seed), *(with_losses(batch) for batch in random_steps(seed, steps=6))]
    for solvers in ((quick, usual), (Solver(), Solver())):
        assert {stage_both(*solvers, batch) for batch in batches} <= {"", "duplicate_variable", "unknown_variable"}


def with_losses(batch: Batch) -> Batch:
    """Each group of factors with another loss."""
    names = [*LOSSES, ""]
    return batch._replace(
        factors=tuple(
            group._replace(loss=loss, scale=np.linspace(0.5, 3.0, len(group.keys)) if loss else None)
            for group, loss in zip(batch.factors, names * len(batch.factors), strict=False)
        )
    )


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
    held = graph_in(quick).mark()
    codes = set()
    for bad in damaged(last, np.random.default_rng(seed)):
        codes.add(stage_both(quick, usual, bad))
        for solver in (quick, usual):
            graph_in(solver).forget(held)
    assert len(codes) > 2
    assert stage_both(quick, usual, last) == ""


@pytest.mark.parametrize("behind", [0, 1, -2, 2**40])
@pytest.mark.parametrize("bad", [0, 1, 2])
def test_a_lens_that_is_none_is_refused_whatever_stands_behind_the_last_group(bad: int, behind: int) -> None:
    """Nobody has written there.  With 1 in the last row the table had no end, and the kernel read on beyond it."""
    unit, good = np.array([[1.0, 0, 1.0]]), [320, 240, 1, 500, 500, 320, 240, *[0] * 6]
    lenses = [[*good[:3], 0, *good[4:]] if n == bad else good for n in range(3)]
    groups = [Factors("point_seen", np.array([[1, 2]]), np.array([lens], float), unit) for lens in lenses]
    point = Variables("point3", np.array([2]), np.array([[0, 0, 2.0]]))
    held = Variables("se3", np.array([1]), np.array([[0, 0, 0, 0, 0, 0, 1.0]]), fixed=True)
    solver = Solver()
    solver.stage(Batch((held,)))
    solver.step()
    before = arenas(solver)
    message = codec.encode_insert(Insert(1, Batch((point,), tuple(groups))))
    parsed = try_parse(message, REQUEST_LIMITS)
    assert parsed is not None
    table = parsed[3].groups
    fill_unwritten(table, behind)
    for _ in range(2):
        with pytest.raises(SolverError) as refused:
            solver.stage(Columns(message, table))
        assert refused.value.code == "bad_lens"
        assert arenas(solver) == before


def value_of(kind: str, n: int) -> np.ndarray:
    """Somewhere that all kinds of factors can be evaluated."""
    quaternion = [0.0, 0.0, 0.0, 1.0]
    special = {
        "se3": [0.2, 0.1, -3.0 * n, *quaternion], "so3": quaternion, "sim3": [1.0 * n, 0.0, 0.0, *quaternion, 1.0],
        "point3": [0.1, 0.2, 5.0], "idp": [0.0, 0.0, 0.0, 0.1, 0.1, 0.5],
    }  # fmt: skip
    return np.array(special.get(kind, [0.3 + n] * VARIABLE_KINDS[kind].size), float)


@pytest.mark.parametrize("name", FACTOR_KINDS)
def test_any_number_of_any_kind_may_be_odd_whatever_stands_behind_the_last_group(name: str) -> None:
    """A code, the same as from arrays, and no trace; or it is taken by both."""
    kind = FACTOR_KINDS[name]
    keys = np.arange(1, len(kind.connects) + 1)
    held = [Variables(of, keys[n : n + 1], value_of(of, n)[None], True) for n, of in enumerate(kind.connects)]
    good = Factors(name, keys[None], np.array([kind.example], float), np.eye(kind.dim)[np.triu_indices(kind.dim)][None])
    codes = set()
    for column in ("measured", "information"):
        for place in range(getattr(good, column).shape[1]):
            quick, usual = Solver(), Solver()
            for solver in (quick, usual):
                solver.stage(Batch(tuple(held)))
            for odd in (0.0, -1.0, np.nan, np.inf, 5e-324, 1e300, 7.0):
                numbers = getattr(good, column).copy()
                numbers[0, place] = odd
                codes.add(stage_both(quick, usual, Batch((), (good._replace(**{column: numbers}),)), behind=1))
    assert "not_finite" in codes
    assert len(codes) > 1
