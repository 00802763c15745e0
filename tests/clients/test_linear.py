"""Linear factors as a front end drafts them: of any variables and rows; the optimum is that of dense matrices."""

from dataclasses import dataclass

import numpy as np
import pytest
from naive.dense_factors import TANGENT, boxminus, boxplus
from naive.dense_least_squares import distance, full
from naive.random_graphs import random_value
from naive.solver_parts import graph_in, joined_by

from factorbus.client import Draft
from factorbus.proto import codec
from factorbus.proto.kinds import MOST_JOINED
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.proto.problems import BadShape, Problem
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes

MODES = ("bayes-tree", "inc-l", "all-batch")


@dataclass
class Known:
    """|Σ H (x ⊟ y) + b|² by Ω, of any variables."""

    names: list[str]
    kinds: list[str]
    y: list[np.ndarray]
    H: list[np.ndarray]
    b: np.ndarray
    information: np.ndarray

    def draft(self, draft: Draft) -> Draft:
        return draft.linear(self.names, self.y, self.H, self.b, kinds=self.kinds, information=self.information)

    def residual(self, at: dict[str, np.ndarray]) -> np.ndarray:
        r = self.b.copy()
        for name, kind, y, H in zip(self.names, self.kinds, self.y, self.H, strict=True):
            r += H @ boxminus(kind, at[name], y)
        return r


def optimum(kinds: dict[str, str], at: dict[str, np.ndarray], held: list[Known]) -> tuple[dict[str, np.ndarray], float]:
    """By Gauss–Newton with dense matrices and central differences: (values, χ²)."""
    starts, size = {}, 0
    for name, kind in kinds.items():
        starts[name], size = size, size + TANGENT[kind]
    for _ in range(30):
        Lambda, eta = np.zeros((size, size)), np.zeros(size)
        for known in held:
            J = np.zeros((len(known.b), size))
            for name in known.names:
                for c in range(TANGENT[kinds[name]]):
                    step = 1e-5 * np.eye(TANGENT[kinds[name]])[c]
                    ends = [
                        known.residual(at | {name: boxplus(kinds[name], at[name], sign * step)}) for sign in (1, -1)
                    ]
                    J[:, starts[name] + c] = (ends[0] - ends[1]) / 2e-5
            Lambda += J.T @ known.information @ J
            eta -= J.T @ known.information @ known.residual(at)
        delta = np.linalg.solve(Lambda, eta)
        at = {
            name: boxplus(kind, at[name], delta[starts[name] : starts[name] + TANGENT[kind]])
            for name, kind in kinds.items()
        }
        if np.abs(delta).max() < 1e-11:
            break
    return at, float(sum(known.residual(at) @ known.information @ known.residual(at) for known in held))


def solved(batch: Batch, mode: str = "bayes-tree") -> Solver:
    came = codec.decode_insert(codec.encode_insert(Insert(1, batch))).batch
    solver = Solver(Options(mode=mode))
    solver.stage(came)
    solver.step(settle=True)
    return solver


def values(solver: Solver) -> dict[int, np.ndarray]:
    return {k: row for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}


def drawn(
    names: list[str], kinds: list[str], near: list[np.ndarray], rows: int, rng: np.random.Generator, off: float = 0.1
) -> Known:
    """What somebody knows of these variables, linearized at values near those given."""
    y = [boxplus(kind, x, off * rng.normal(size=TANGENT[kind])) for kind, x in zip(kinds, near, strict=True)]
    root = rng.normal(size=(rows, rows)) + 3.0 * np.eye(rows)
    return Known(
        names, kinds, y, [rng.normal(size=(rows, TANGENT[kind])) for kind in kinds], off * rng.normal(size=rows),
        root.T @ root,
    )  # fmt: skip


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(8))
def test_any_rows_of_any_variables_have_the_optimum_of_dense_matrices(seed: int, mode: str) -> None:
    rng = np.random.default_rng(seed)
    of = (("se2", "point2"), ("se3", "point3", "idp"))[seed % 2]
    names = [f"v{n}" for n in range(6)]
    kinds = dict(zip(names, [*of, *(str(kind) for kind in rng.choice(of, 6 - len(of)))], strict=True))
    at = {name: random_value(kind, rng) for name, kind in kinds.items()}
    held = [drawn([name], [kinds[name]], [at[name]], TANGENT[kinds[name]], rng) for name in names]
    for _ in range(6):
        some = [str(name) for name in rng.permutation(names)[: rng.integers(1, 6)]]
        held.append(drawn(some, [kinds[n] for n in some], [at[n] for n in some], int(rng.integers(1, 17)), rng))
    draft = Draft()
    for name, kind in kinds.items():
        draft.variable(kind, name, at[name])
    for known in held:
        known.draft(draft)
    solver = solved(draft.batch(), mode)
    wanted, chi2 = optimum(kinds, at, held)
    for name, kind in kinds.items():
        assert distance(kind, values(solver)[symbol(name[0], int(name[1:]))], wanted[name]) < 1e-7
    assert solver.chi2() == pytest.approx(chi2, rel=1e-7)


def preintegrated(n: int, at: dict[str, np.ndarray], rng: np.random.Generator) -> Known:
    """As an inertial sensor has it after 0.1 s: rows of position, velocity, attitude, and both biases."""
    names = [f"x{n}", f"v{n}", f"x{n + 1}", f"v{n + 1}", f"a{n}", f"g{n}", f"a{n + 1}", f"g{n + 1}"]
    kinds = ["se3", "vector3", "se3", "vector3", "vector3", "vector3", "vector3", "vector3"]
    known = drawn(names, kinds, [at[name] for name in names], 15, rng, 1e-3)
    one, dt, down = np.eye(3), 0.1, np.array([[0, 9.8, 0], [-9.8, 0, 0], [0, 0, 0]])
    rows_of = (  # of each end: (row, column, block)
        [(0, 0, -one), (0, 3, 0.5 * dt**2 * down), (3, 3, dt * down), (6, 3, -one)],
        [(0, 0, -dt * one), (3, 0, -one)],
        [(0, 0, one), (6, 3, one)],
        [(3, 0, one)],
        [(0, 0, 0.5 * dt**2 * one), (3, 0, dt * one), (9, 0, -one)],
        [(6, 0, dt * one), (12, 0, -one)],
        [(9, 0, one)],
        [(12, 0, one)],
    )
    for H, blocks in zip(known.H, rows_of, strict=True):
        H[:] *= 0.01
        for row, column, block in blocks:
            H[row : row + 3, column : column + 3] += block
    sigma = np.repeat([1e-3, 3e-3, 1e-3, 1e-3, 1e-3], 3)
    known.b *= sigma
    known.information = np.diag(1.0 / sigma**2)
    return known


def inertial(count: int, rng: np.random.Generator) -> tuple[dict[str, str], dict[str, np.ndarray], list[Known]]:
    """A drive with such factors only, but for what is known of the first state."""
    kinds, at = {}, {}
    for n in range(count):
        pose = boxplus("se3", np.array([0.5 * n, 0, 0, 0, 0, 0, 1.0]), 0.1 * rng.normal(size=6))
        at |= {f"x{n}": pose, f"v{n}": np.array([1.0, 0, 0]) + 0.1 * rng.normal(size=3)}
        at |= {f"a{n}": 0.1 * rng.normal(size=3), f"g{n}": 0.1 * rng.normal(size=3)}
        kinds |= {f"x{n}": "se3", f"v{n}": "vector3", f"a{n}": "vector3", f"g{n}": "vector3"}
    sigmas, held = {"x": 0.01, "v": 0.1, "a": 0.05, "g": 0.005}, []
    for c, sigma in sigmas.items():
        d = TANGENT[kinds[f"{c}0"]]
        held.append(Known([f"{c}0"], [kinds[f"{c}0"]], [at[f"{c}0"]], [np.eye(d)], np.zeros(d), np.eye(d) / sigma**2))
    return kinds, at, held + [preintegrated(n, at, rng) for n in range(count - 1)]


def test_preintegrated_motion_between_states_of_four_variables() -> None:
    rng = np.random.default_rng(5)
    kinds, at, held = inertial(4, rng)
    held.append(drawn(["x3", "v1"], ["se3", "vector3"], [at["x3"], at["v1"]], 9, rng, 0.02))
    draft = Draft()
    for name, kind in kinds.items():
        draft.variable(kind, name, at[name])
    for known in held:
        known.draft(draft)
    solver = solved(draft.batch())
    wanted, chi2 = optimum(kinds, at, held)
    for name, kind in kinds.items():
        assert distance(kind, values(solver)[symbol(name[0], int(name[1:]))], wanted[name]) < 1e-7
    assert chi2 > 1e-3
    assert solver.chi2() == pytest.approx(chi2, rel=1e-7)


@pytest.mark.parametrize("mode", MODES)
def test_a_chain_of_them_is_undone_and_slides(mode: str) -> None:
    """Step by step they overlap without end."""
    rng, count, each = np.random.default_rng(6), 40, []
    kinds, at, held = inertial(count, rng)
    solver, window = Solver(Options(mode=mode)), Solver(Options(mode=mode))
    for n in range(count):
        draft = Draft()
        for name in (f"x{n}", f"v{n}", f"a{n}", f"g{n}"):
            draft.variable(kinds[name], name, at[name])
        for known in held[:4] if n == 0 else [held[n + 3]]:
            known.draft(draft)
        for of in (window, solver):
            first = of.stage(draft.batch())
            of.step()
        each.append((first, draft.batch().factor_count))
        if n % 10 == 9:
            gone = [symbol(c, k) for c in "xvag" for k in range(n - 9, n - 4) if n > 9]
            gone += [symbol(c, k) for c in "xvag" for k in range(5) if n == 9]
            gone = [key for key in gone if graph_in(window).find(key) >= 0]
            window, *_ = with_changes(window, [Change("marginalize", keys=np.array(gone))])
    assert [len(keys) for keys in joined_by(solver)] == [8] * (count - 1)
    assert window.factor_count < solver.factor_count
    assert max(map(len, joined_by(window))) <= 8
    for of in (solver, window):
        of.step(settle=True)
    # The newest is undone, its variables with it; the one in the middle of all leaves its neighbours what they are.
    ids = np.arange(each[-1][0], sum(each[-1]))
    last = np.array([symbol(c, count - 1) for c in "xvag"])
    undone, *_ = with_changes(
        solver, [Change("remove_factors", ids), Change("remove_variables", keys=last, alone=True)]
    )
    assert len(joined_by(undone)) == count - 2
    # Sent on to another map they are the same.
    variables, factors = solver.graph()
    other = Solver(Options(mode=mode))
    other.stage(Batch(tuple(variables), tuple(factors)))
    other.step(settle=True)
    assert joined_by(other) == joined_by(solver)
    for key, row in values(other).items():
        assert np.abs(row - values(solver)[key]).max() < 1e-7  # the last is known to half a metre
    # A marginal of one state has the next one in its separator, and nothing else.
    slid, *_ = with_changes(solver, [Change("marginalize", keys=np.array([symbol(c, 0) for c in "xvag"]))], settle=True)
    widths = sorted(map(len, joined_by(slid)))
    assert widths == [4] + [8] * (count - 2)
    for key, row in values(slid).items():
        assert np.abs(row - values(solver)[key]).max() < 1e-7


def test_it_is_one_factor_as_it_was_said() -> None:
    pose, point = (0, 0, 0, 0, 0, 0, 1), (1, 2, 3)
    H, b = [np.ones((2, 3)), np.ones((2, 6))], (0.5, 0.25)
    draft = Draft().linear(
        ["l1", "x1"], [point, pose], H, b, kinds=["point3", "se3"], sigmas=(1, 2), loss=("huber", 1.5)
    )
    (group,) = draft.batch().factors
    assert (group.kind, group.loss) == ("linear_2_point3_se3", "huber")
    assert group.keys.tolist() == [[symbol("l", 1), symbol("x", 1)]]
    np.testing.assert_array_equal(full(group.information[0]), np.diag([1.0, 0.25]))
    draft = Draft().se2("x1").linear(["x1"], [(1, 2, 0.5)], [np.eye(3)], np.zeros(3), sigmas=(1, 1, 2))
    (group,) = draft.batch().factors
    assert group.kind == "linear_3_se2"
    (group,) = (
        Draft().linear(["v1"], [point], [np.eye(3)], np.zeros(3), sigmas=(1, 1, 2), kinds=["point3"]).batch().factors
    )
    assert group.kind == "linear_3_point3"


def test_the_kinds_of_what_is_in_the_draft_need_not_be_said() -> None:
    draft = Draft().se3("x1", (0, 0, 0, 0, 0, 0, 1)).vector("v1", (1, 0, 0)).vector("s1", [1.5])
    H = [np.ones((2, 6)), np.ones((2, 3)), np.ones((2, 1)), np.ones((2, 4))]
    y = [(0, 0, 0, 0, 0, 0, 1), (1, 0, 0), (1.5,), (4, 5, 6, 7)]
    (group,) = draft.linear(["x1", "v1", "s1", "w1"], y, H, (0, 0), sigmas=(1, 1)).batch().factors
    assert group.kind == "linear_2_se3_vector3_vector1_vector4"
    with pytest.raises(Problem):
        Draft().vector("v1", np.zeros(10))


ROW7 = (0.0, 0, 0, 0, 0, 0, 1)


@pytest.mark.parametrize(
    ("numbers", "columns", "kind"),
    [*((n, n, f"vector{n}") for n in (1, 4, 5, 7, 8, 9)), (7, 6, "se3"), (2, 2, ""), (3, 3, ""), (6, 6, "")],
)
def test_of_an_earlier_insert_a_kind_is_only_taken_that_can_be_no_other(numbers: int, columns: int, kind: str) -> None:
    """A prior on a bias was sent as an idp, one on a velocity as an se2."""
    said = (["b5"], [ROW7[-numbers:] if numbers < 8 else np.zeros(numbers)], [np.ones((2, columns))], (0, 0))
    if kind:
        (group,) = Draft().linear(*said, sigmas=(1, 1)).batch().factors
        assert group.kind == f"linear_2_{kind}"
        return
    with pytest.raises(
        BadShape, match=rf"value of b5, which is not.* or vector{numbers}; wanted kinds=.*vector{numbers}"
    ):
        Draft().linear(*said, sigmas=(1, 1))
    (group,) = Draft().linear(*said, sigmas=(1, 1), kinds=[f"vector{numbers}"]).batch().factors
    assert group.kind == f"linear_2_vector{numbers}"


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"keys": []}, "bad_shape"),
        ({"keys": ["x1", "x1"]}, "bad_shape"),
        ({"keys": [f"x{n}" for n in range(MOST_JOINED + 1)]}, "bad_shape"),
        ({"values": [(0, 0, 0, 0, 0, 0, 1)]}, "bad_shape"),
        ({"values": [(0, 0, 0, 0, 0, 0, 1), (1, 2)]}, "bad_shape"),
        ({"values": [(0, 0, 0, 0), (1, 2, 3)]}, "bad_shape"),
        ({"jacobians": [np.eye(3), np.eye(3)]}, "bad_shape"),
        ({"residual": []}, "bad_shape"),
        ({"kinds": ["se3", "point2"]}, "bad_shape"),
        ({"kinds": ["se3", "velocity"]}, "unknown_kind"),
        ({"information": np.diag([1.0, 1, 1, 1, 1, -1])}, "bad_information"),
    ],
)
def test_what_is_wrong_is_refused_before_it_is_sent(change: dict, code: str) -> None:
    said = {
        "keys": ["x1", "l1"],
        "values": [(0, 0, 0, 0, 0, 0, 1), (1, 2, 3)],
        "jacobians": [np.ones((6, 6)), np.ones((6, 3))],
        "residual": np.zeros(6),
        "information": np.eye(6),
        "kinds": ["se3", "point3"],
    }
    Draft().linear(**said)
    with pytest.raises(Problem) as refused:
        Draft().linear(**said | change)
    assert refused.value.code == code
