"""Every way a batch is refused, and that a refused batch leaves no trace."""

import pickle
from typing import Any

import numpy as np
import pytest
from naive.random_graphs import random_steps
from naive.solver_parts import graph_in, stepper_in, system_in
from naive.tree_records import tree_of

from factorbus.client import Draft
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, errors
from factorbus.solver.inc_l.steps import IncrementalSteps
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.sparse.blocks import HessianBlocks

I3 = np.array([[1.0, 0, 0, 1, 0, 1]])
I2 = np.array([[1.0, 0, 1]])
I6 = np.eye(6)[np.triu_indices(6)][None]
IDENTITY = np.array([[0.0, 0, 0, 0, 0, 0, 1]])


def poses(*keys: int, values: np.ndarray | None = None) -> Variables:
    return Variables("se2", np.array(keys), np.zeros((len(keys), 3)) if values is None else values)


def edge(i: int, j: int, z: tuple = (1.0, 0, 0), info: np.ndarray = I3) -> Factors:
    return Factors("between_se2", np.array([[i, j]]), np.array([z], float), info)


def seen(i: int, j: int) -> Factors:
    return Factors("landmark_se2", np.array([[i, j]]), np.ones((1, 2)), I2)


def nan_info() -> np.ndarray:
    info = I3.copy()
    info[0, 4] = np.nan
    return info


def observation(z: float = 5.0, model: float = 1.0) -> Batch:
    lens = [model, 400, 400, 320, 240, 0, 0, 0, 0, 0, 0]
    return Batch(
        (Variables("point3", np.array([300]), np.array([[0, 0, z]])),),
        (Factors("point_seen", np.array([[200, 300]]), np.array([[320.0, 240, *lens]]), I2),),
    )


def observation_with(k2: float) -> Batch:
    batch = observation()
    batch.factors[0].measured[0, 9] = k2
    return batch


LANDMARK = Variables("point2", np.array([2]))

# What every map of these tests holds: pose 0 (fixed), pose 1, landmark 100, and a pose in space 200.
REFUSED = {
    "unknown variable kind": ("unknown_kind", Batch((Variables("se4", np.array([2])),))),
    "unknown factor kind": ("unknown_kind", Batch((), (Factors("behind_se2", np.array([[0, 1]]), I3[:, :3], I3),))),
    "key taken": ("duplicate_variable", Batch((poses(1),))),
    "key twice in the batch": ("duplicate_variable", Batch((poses(2, 3, 2),))),
    "key twice in two groups": ("duplicate_variable", Batch((poses(2), Variables("point2", np.array([2]))))),
    "first key unknown": ("unknown_variable", Batch((), (edge(9, 1),))),
    "second key unknown": ("unknown_variable", Batch((), (edge(1, 9),))),
    "self-loop": ("self_loop", Batch((), (edge(1, 1),))),
    "pose where a point belongs": (
        "kind_mismatch", Batch((), (seen(0, 1),)),
    ),
    "point where a pose belongs": ("kind_mismatch", Batch((), (edge(0, 100),))),
    "pose in space where one in the plane belongs": ("kind_mismatch", Batch((), (edge(200, 1),))),
    "NaN value": ("not_finite", Batch((poses(2, values=np.array([[0, np.nan, 0]])),))),
    "infinite value": ("not_finite", Batch((poses(2, values=np.array([[np.inf, 0, 0]])),))),
    "NaN measurement": ("not_finite", Batch((), (edge(0, 1, (np.nan, 0, 0)),))),
    "NaN information": ("not_finite", Batch((), (edge(0, 1, info=nan_info()),))),
    "value that squares to more than numbers": ("out_of_bounds", Batch((poses(2, values=np.array([[0, 1e200, 0]])),))),
    "value just beyond its bound": ("out_of_bounds", Batch((poses(2, values=np.array([[0, 0, -1.001e12]])),))),
    "measurement beyond its bound": ("out_of_bounds", Batch((), (edge(0, 1, (1e13, 0, 0)),))),
    "values composed to beyond their bound": (
        "out_of_bounds", Batch((poses(2)._replace(values=None), poses(3)._replace(values=None)),
                               (edge(0, 2, (9e11, 0, 0)), edge(2, 3, (9e11, 0, 0)))),
    ),
    "information beyond its bound": ("out_of_bounds", Batch((), (edge(0, 1, info=1e25 * I3),))),
    "information below its bound": ("out_of_bounds", Batch((), (edge(0, 1, info=1e-25 * I3),))),
    "H of a linear factor beyond its bound": (
        "out_of_bounds",
        Batch((), (Factors("linear_2_point2", np.array([[100]]), np.array([[0, 0, 1, 0, 0, 1e25, 0, 0]]), I2),)),
    ),
    "lens beyond its bound": ("out_of_bounds", observation_with(k2=1e300)),
    "indefinite information": ("not_positive_definite", Batch((), (edge(0, 1, info=I3 + np.eye(6)[1:2] * 2),))),
    "singular information": ("not_positive_definite", Batch((), (edge(0, 1, info=np.ones((1, 6))),))),
    "zero information": ("not_positive_definite", Batch((), (edge(0, 1, info=np.zeros((1, 6))),))),
    "negative information": ("not_positive_definite", Batch((), (edge(0, 1, info=-I3),))),
    "quaternion of length 2 in a value": (
        "bad_quaternion", Batch((Variables("se3", np.array([2]), 2 * IDENTITY),)),
    ),
    "quaternion of length 0 in a value": (
        "bad_quaternion", Batch((Variables("se3", np.array([2]), 0 * IDENTITY),)),
    ),
    "quaternion of length 0.9 in a measurement": (
        "bad_quaternion", Batch((), (Factors("prior_se3", np.array([[200]]), 0.9 * IDENTITY, I6),)),
    ),
    "range of zero": (
        "bad_range", Batch((), (Factors("bearing_range_se2", np.array([[0, 100]]), np.zeros((1, 2)), I2),)),
    ),
    "point behind the camera": ("bad_observation", observation(z=-5.0)),
    "lens of no model": ("bad_lens", observation(model=9.0)),
    "loss of no kind": ("bad_loss", Batch((), (edge(0, 1)._replace(loss="welsch", scale=np.ones(1)),))),
    "loss with a scale beyond its bound": (
        "bad_loss", Batch((), (edge(0, 1)._replace(loss="dcs", scale=np.full(1, 1e13)),)),
    ),
    "loss with a scale of zero": ("bad_loss", Batch((), (edge(0, 1)._replace(loss="huber", scale=np.zeros(1)),))),
    "variable without value that nothing reaches": (
        "uninitialized", Batch((Variables("se2", np.array([2, 3])),), (edge(1, 2),)),
    ),
    "pose that only a point could place": (
        "uninitialized",
        Batch((Variables("se2", np.array([2])),), (seen(2, 100),)),
    ),
    "keys in two dimensions": ("bad_shape", Batch((Variables("se2", np.array([[2]])),))),
    "keys that are no integers": ("bad_shape", Batch((Variables("se2", np.array([2.0])),))),  # type: ignore[arg-type]
    "values of another size": ("bad_shape", Batch((Variables("se2", np.array([2]), np.zeros((1, 4))),))),
    "fewer values than keys": ("bad_shape", Batch((Variables("se2", np.array([2, 3]), np.zeros((1, 3))),))),
    "factor with three ends": ("bad_shape", Batch((), (Factors("between_se2", np.array([[0, 1, 1]]), I3[:, :3], I3),))),
    "measurement of another size": ("bad_shape", Batch((), (Factors("between_se2", np.array([[0, 1]]), I3, I3),))),
    "information of another size": ("bad_shape", Batch((), (edge(0, 1, info=I2),))),
    "a list": ("bad_shape", Batch((Variables("se2", [2]),))),  # type: ignore[arg-type]
    "alone": ("underconstrained", Batch((poses(2),))),
    "two poses joined to each other only": ("underconstrained", Batch((poses(2, 3),), (edge(2, 3),))),
    "pose seen by one point only": (
        "underconstrained",
        Batch((poses(2),), (seen(2, 100),)),
    ),
    "new point seen by a new pose only": (
        "underconstrained",
        Batch(
            (poses(2), Variables("point2", np.array([101, 102]), np.ones((2, 2)))),
            (Factors("landmark_se2", np.array([[2, 101], [2, 102]]), np.ones((2, 2)), np.repeat(I2, 2, 0)),),
        ),
    ),
}  # fmt: skip


ADVICE = {
    "value just beyond its bound": "choose units and an origin near the data",
    "measurement beyond its bound": "choose units and an origin near the data",
    "information beyond its bound": "give a larger sigma",
    "information below its bound": "give a smaller sigma",
}


@pytest.mark.parametrize("name", ADVICE)
def test_the_advice_is_for_what_is_out_of_bounds(name: str) -> None:
    with pytest.raises(errors.SolverError, match=ADVICE[name] + "$"):
        small_map().stage(REFUSED[name][1])


def small_map(mode: str = "auto") -> Solver:
    solver = Solver(Options(mode=mode))
    solver.stage(
        Batch(
            (
                Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True),
                Variables("se2", np.array([1])),
                Variables("point2", np.array([100])),
                Variables("se3", np.array([200]), IDENTITY),
            ),
            (
                edge(0, 1),
                Factors("landmark_se2", np.array([[0, 100]]), np.ones((1, 2)), I2),
                Factors("prior_se3", np.array([[200]]), IDENTITY, I6),
            ),
        )
    )
    solver.step()
    return solver


def everything(solver: Solver) -> bytes:
    """All there is to see of a solver and of what it keeps, to the bit."""
    graph = graph_in(solver)
    n, m, v, p, _, scalars, *_ = graph.counts.tolist()
    return pickle.dumps(
        [
            [
                a.tobytes()
                for a in (graph.counts, graph.keys[:n], graph.stamps[:n], graph.values[:v], *rows(solver, n, m))
            ],
            [graph.payload[:p].tobytes(), graph.table.nonzero()[0].size],
            normal_equations(system_in(solver).blocks, scalars)
            if isinstance(stepper_in(solver), IncrementalSteps)
            else cliques(solver, n, m, v),
            [solver.chi2(), [(g.kind, g.keys.tolist(), g.values.tobytes()) for g in solver.changed()]],
        ]
    )


def rows(solver: Solver, variables: int, factors: int) -> tuple[np.ndarray, np.ndarray]:
    """What the graph says of them; in the mode "bayes-tree" nobody writes where blocks of Λ are."""
    var, fac = graph_in(solver).var[:variables], graph_in(solver).fac[:factors]
    return (
        (var, fac) if isinstance(stepper_in(solver), IncrementalSteps) else (var[:, : at.V_DIAGONAL], fac[:, : at.F_II])
    )


def normal_equations(blocks: HessianBlocks, scalars: int) -> list[bytes]:
    kept = (blocks.table.nonzero()[0], blocks.fill, blocks.rows, blocks.cols, blocks.offsets)
    return [a.tobytes() for a in (*kept, blocks.data[: blocks.fill[1]], blocks.eta[:scalars])]


def cliques(solver: Solver, variables: int, factors: int, values: int) -> list[bytes]:
    tree, scratch = tree_of(solver), (tl.N_STAMP, tl.N_LOCAL, tl.N_COLUMN)
    kept, links = np.delete(tree.node[:variables], scratch, axis=1), tree.link[:factors, [tl.L_OWN, tl.L_I, tl.L_AT]]
    scalars = tree.scalars[:2, : graph_in(solver).counts[at.SCALARS]]
    return [a.tobytes() for a in (kept, links, tree.lin[0, :values], scalars, tree.turns[:variables, tl.U_LEVER])]


@pytest.mark.filterwarnings("ignore:overflow encountered")  # from plain Python, where kernels are not compiled
@pytest.mark.parametrize("mode", ["inc-l", "bayes-tree"])
@pytest.mark.parametrize("name", REFUSED)
def test_bad_batches_are_refused_whole(name: str, mode: str) -> None:
    code, bad = REFUSED[name]
    solver = small_map(mode)
    before = everything(solver)
    good = Batch((poses(50),), (edge(1, 50),))
    mixed = Batch(good.variables + bad.variables, good.factors + bad.factors)
    for batch in (bad, mixed):
        with pytest.raises(errors.SolverError) as caught:  # noqa: PT012
            solver.stage(batch)
            solver.step()
        assert caught.value.code == code
        assert caught.value.message
        assert all(isinstance(value, (int, float, str, list)) for value in caught.value.detail.values())
        assert everything(solver) == before
    solver.stage(good)
    solver.step()
    assert solver.variable_count == 5


def test_every_code_is_in_the_table() -> None:
    codes = {error.code for error in errors.SolverError.__subclasses__()}
    elsewhere = {"unknown_mode", "bad_option", "no_backend", "unknown_factor", "diverged"}
    elsewhere |= {
        "in_use",
        "bad_weight",
        "too_connected",
        "bad_order",
        "bad_direction",
        "bad_samples",
        "kind_taken",
        "named_twice",
        "too_large",
        "not_a_closure",
        "switched_off",
    }  # changes, other kinds, closures
    assert codes - elsewhere == {code for code, _ in REFUSED.values()}


@pytest.mark.parametrize("position", range(6))
def test_one_bad_row_among_many_refuses_all_of_them(position: int) -> None:
    solver = small_map()
    before = everything(solver)
    z = np.ones((6, 3))
    z[position, 1] = np.nan
    with pytest.raises(errors.NotFinite, match="between_se2"):
        solver.stage(Batch((), (Factors("between_se2", np.array([[0, 1]] * 6), z, np.repeat(I3, 6, 0)),)))
    assert everything(solver) == before


def test_read_only_and_strided_arrays_are_taken() -> None:
    def awkward(array: np.ndarray) -> np.ndarray:
        twice = np.repeat(array, 2, axis=0)[::2]
        twice.flags.writeable = False
        return twice

    plain, other = Solver(), Solver()
    for batch in random_steps(1, steps=3):
        plain.stage(batch)
        other.stage(
            Batch(
                tuple(
                    Variables(
                        v.kind,
                        awkward(v.keys),
                        None if v.values is None else awkward(v.values),
                        v.fixed,
                        None if v.stamps is None else awkward(v.stamps),
                    )
                    for v in batch.variables
                ),
                tuple(
                    Factors(f.kind, awkward(f.keys), awkward(f.measured), awkward(f.information)) for f in batch.factors
                ),
            )
        )
    plain.step()
    other.step()
    assert everything(plain) == everything(other)


def test_keys_print_as_symbols_in_messages() -> None:
    x12 = ord("x") << 56 | 12
    with pytest.raises(errors.UnknownVariable, match=r"between_se2 \(x12, 1\): there is no variable x12"):
        small_map().stage(Batch((), (edge(x12, 1),)))


def test_angles_are_wrapped_and_quaternions_made_unit() -> None:
    solver = small_map()
    nearly = IDENTITY * 1.0001
    solver.stage(
        Batch(
            (
                Variables("se2", np.array([7]), np.array([[0, 0, 3 * np.pi]]), fixed=True),
                Variables("se3", np.array([8]), nearly, fixed=True),
            )
        )
    )
    values = {int(key): v for g in solver.estimate() for key, v in zip(g.keys, g.values, strict=True)}
    assert -np.pi <= values[7][2] < np.pi
    assert np.linalg.norm(values[8][3:]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("batch", "said"),
    [
        (REFUSED["key taken"][1], "variable 1 exists already"),
        (REFUSED["key twice in the batch"][1], "variable 2 comes twice in one insert"),
        (REFUSED["key twice in two groups"][1], "variable 2 comes twice in one insert"),
        (Batch((LANDMARK,)), "variable 2 has no value and no factor of its batch is on it"),
        (
            Batch(
                (Variables("point2", np.array([2])),),
                (Factors("range_se2", np.array([[0, 2]]), np.ones((1, 1)), np.ones((1, 1))),),
            ),
            r"variable 2 has no value and what is on it in its batch, range_se2 \(0, 2\), gives it none",
        ),
    ],
)
def test_a_refusal_says_where_the_other_is_and_what_was_tried(batch: Batch, said: str) -> None:
    with pytest.raises(errors.SolverError, match=said):
        small_map().stage(batch)


def test_a_draft_is_no_batch_and_is_told_how_it_becomes_one() -> None:
    draft: Any = Draft().se2("x0", (0, 0, 0), fixed=True)
    with pytest.raises(errors.BadShape, match="seen an object of type Draft, wanted a Batch; of a Draft"):
        small_map().stage(draft)


@pytest.mark.parametrize(
    ("factor", "following", "said"),
    [
        (3, 0, "no factor 3: the map has had none so far;"),
        (3, 2, "no factor 3: the next one will be 2;"),
        (1, 2, "no factor 1: it has been removed, or is one of the map's suspects, which the estimate does not have;"),
    ],
)
def test_a_factor_that_there_is_not_is_told_from_one_that_there_was(factor: int, following: int, said: str) -> None:
    assert said in str(errors.UnknownFactor(factor, following))
