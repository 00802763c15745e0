"""The machine code of own kinds: there while a graph has the kind, gone afterwards, and found by its number alone."""

import gc
import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from factorbus.proto.expressions.declaration import MOST_RESULTS, BadExpression
from factorbus.proto.expressions.formula import read_formula
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Solver, errors
from factorbus.solver.formulas import own_code
from factorbus.solver.formulas.own_code import OwnCode, own_code_of
from factorbus.solver.formulas.residual import NAME, residual_code
from factorbus.solver.kernels.jit import machine_code
from factorbus.solver.kernels.jit.machine_code import MachineCode, address_of_function

SCALED = "scaled(a:vector1,z:1)=subtract(multiply(a,{}),z)"


@pytest.fixture(autouse=True)
def _nothing_kept() -> Iterator[None]:
    """Code that no graph has is not kept from other tests, nor for them."""
    own_code._made.cache_clear()
    yield
    own_code._made.cache_clear()


def solved(formula: str, z: float = 6.0) -> Solver:
    solver = Solver()
    solver.stage(
        Batch(
            (Variables("vector1", np.array([1]), np.array([[1.0]])),),
            (Factors(formula, np.array([[1]]), np.array([[z]]), np.array([[1.0]])),),
        )
    )
    solver.step()
    return solver


def value_in(solver: Solver) -> float:
    return float(solver.estimate()[0].values[0, 0])


def numbers() -> set[int]:
    """Of the functions that kernels can call."""
    there = machine_code._TABLE[:, 0]
    return set(there[there > 0].tolist())


def test_code_is_there_as_long_as_a_graph_has_the_kind() -> None:
    before, formula = numbers(), SCALED.format("3")
    solver = solved(formula)
    number = own_code_of(formula).number
    assert value_in(solver) == pytest.approx(2.0)
    own_code._made.cache_clear()
    gc.collect()
    assert number in numbers() - before
    solver.stage(Batch((), (Factors(formula, np.array([[1]]), np.array([[9.0]]), np.array([[1.0]])),)))
    solver.step()
    assert value_in(solver) == pytest.approx(2.5)
    del solver
    own_code._made.cache_clear()
    gc.collect()
    assert number not in numbers()
    assert value_in(solved(formula)) == pytest.approx(2.0)


def test_functions_whose_numbers_fall_on_one_place_are_told_apart() -> None:
    """Also after one of them is gone, and another comes in its place."""
    text = residual_code(read_formula(SCALED.format("3")))
    first, second, third = (MachineCode(77 + k * machine_code._SLOTS, text, NAME) for k in range(3))
    where = [address_of_function(77 + k * machine_code._SLOTS) for k in range(4)]
    assert len(set(where[:3])) == 3
    assert where[3] == 0
    del first
    assert [address_of_function(77 + k * machine_code._SLOTS) for k in range(4)] == [0, *where[1:]]
    fourth = MachineCode(77 + 3 * machine_code._SLOTS, text, NAME)
    now = [address_of_function(77 + k * machine_code._SLOTS) for k in range(4)]
    assert now[:3] == [0, *where[1:3]]
    assert now[3] not in (0, *where[1:])
    del second, third, fourth
    assert not any(address_of_function(77 + k * machine_code._SLOTS) for k in range(4))


def test_a_formula_with_the_number_of_another_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its factors would be computed by the other's code."""
    monkeypatch.setattr(own_code, "_number_of", lambda _formula: 5)
    first = own_code_of(SCALED.format("3"))
    with pytest.raises(errors.KindTaken):
        own_code_of(SCALED.format("4"))
    assert own_code_of(first.formula) is first


def test_a_choice_between_what_does_not_change_has_no_slope() -> None:
    """Zeros of either sign are one."""
    solver, formula = Solver(), "chosen(a:vector1,z:1)=vector(subtract(a,z),select(z,negate(z),z))"
    variables = (Variables("vector1", np.array([1]), np.array([[1.0]])),)
    solver.stage(Batch(variables, (Factors(formula, np.array([[1]]), np.array([[6.0]]), np.array([[1.0, 0.0, 1.0]])),)))
    assert solver.step().chi2 == pytest.approx(36.0)
    assert value_in(solver) == pytest.approx(6.0)


def test_chi2_is_that_of_the_residual_where_a_slope_is_no_number() -> None:
    """By whichever way it is summed: 1e12 √a has a slope beyond 1e12 where a is below a quarter."""
    steep = "steep(a:vector1,z:1)=subtract(multiply(sqrt(a),1e12),z)"
    solver, key = Solver(), np.array([[1]])
    solver.stage(
        Batch(
            (Variables("vector1", np.array([1]), np.array([[0.3]])),),
            (
                Factors(steep, key, np.array([[4e11]]), np.array([[1e-22]])),
                Factors("linear_1_vector1", key, np.array([[0.3, 1.0, 0.0]]), np.array([[1.0]])),
            ),
        )
    )
    for _ in range(3):
        report = solver.step()
        a = value_in(solver)
        assert a < 0.25
        wanted = 1e-22 * (1e12 * np.sqrt(a) - 4e11) ** 2 + (a - 0.3) ** 2
        assert report.chi2 == pytest.approx(wanted, rel=1e-6)
        assert solver.chi2() == pytest.approx(wanted, rel=1e-6)


def test_code_is_made_anew_in_another_process() -> None:
    code = own_code_of(SCALED.format("3"))
    assert pickle.loads(pickle.dumps(code)) is code
    assert code.__reduce__() == (own_code_of, (code.formula,))
    assert isinstance(code, OwnCode)


def test_a_formula_of_too_many_numbers_is_refused_before_code_is_made() -> None:
    many = 64 * "multiply(" + "z" + 64 * ",a)"
    with pytest.raises(BadExpression, match=str(MOST_RESULTS)):
        read_formula(f"much(a:vector1,z:64)={many}")


@pytest.mark.parametrize(
    "known",
    [
        "sqrt([0])",
        "norm([0,0])",
        "atan2([0],[0])",
        "part(log(exp([0,0,0])),0,1)",
        "part(log(exp([3,0,0])),0,1)",
        "select([1],[0],divide([1],[0]))",
        "multiply(sin(multiply([1e200],[1e200])),[0])",
        "wrap(divide([1],[0]))",
        "cos(sqrt([-1]))",
    ],
)
def test_what_is_known_is_computed_as_code_is_made_whatever_it_is(known: str) -> None:
    """A formula that divides by nothing, or whose numbers are none, is taken or refused, and no error of Python's."""
    try:
        solver = solved(f"known(a:vector1,z:1)=subtract(add(a,{known}),z)")
    except errors.NotFinite:
        assert "[1e200]" in known or "wrap" in known or "sqrt([-1])" in known
        return
    assert np.isfinite(value_in(solver))
