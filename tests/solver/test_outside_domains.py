"""Where a formula is no number in NumPy it is none in machine code, and where it is one it is the same."""

import ctypes

import numpy as np
import pytest
from naive.random_formulas import random_formula

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import evaluate, random_value
from factorbus.proto.expressions.formula import read_formula, write_formula
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Solver, errors
from factorbus.solver.formulas.own_code import own_code_of
from factorbus.solver.kernels.jit.machine_code import address_of_function
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import NO_NUMBER

NONE = {
    "a root": "sqrt(negate(norm(a)))",
    "a root times 0": "add(norm(a),multiply(0,sqrt(negate(norm(a)))))",
    "a constant root": "add(norm(a),sqrt(-1))",
    "divided by 0": "divide(norm(a),0)",
    "divided by 0, times 0": "multiply(divide(norm(a),0),0)",
    "divided by 0, its inverse": "add(norm(a),divide(1,divide(norm(a),0)))",
    "divided by what is 0 here": "add(norm(a),multiply(0,divide(1,subtract(norm(a),norm(a)))))",
    "the angle of what is none": "atan2(divide(1,subtract(norm(a),norm(a))),norm(a))",
    "0 turned by what is none": "add(norm(a),norm(rotate(pose([0,0],sqrt(negate(norm(a)))),[0,0])))",
    "a part that is 0 of what is none": "add(norm(a),multiply(0,part(divide(a,0),1,1)))",
}


def code_of(declared: Declaration, values: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """r as the machine code of a formula has it, and NaN where it says that it is no number."""
    code = own_code_of(write_formula(declared))
    places = np.cumsum([0, *(value.size for value in values)])
    var, fac = np.zeros((len(values), at.V_WIDTH), np.int64), np.zeros((len(values), at.F_WIDTH), np.int64)
    var[:, at.V_AT] = places[:-1]
    fac[0, at.F_I] = 0
    fac[: len(values) - 1, at.F_J] = np.arange(1, len(values))
    x, out = np.concatenate(values), np.zeros(declared.residual_size * (declared.scalars + 1) + 8)
    function = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * 6)(int(address_of_function(code.number)))
    found = function(*(array.ctypes.data for array in (x, var, fac, np.asarray(z, float), out)), 0)
    r = out[: declared.residual_size]
    return np.full(r.size, np.nan) if found == NO_NUMBER else r


@pytest.mark.parametrize("body", NONE.values(), ids=NONE)
def test_what_is_no_number_is_refused(body: str) -> None:
    text = f"bad(a:vector2,z:1)=subtract({body},z)"
    with np.errstate(all="ignore"):
        assert np.isnan(evaluate(read_formula(text), [np.array([0.3, 0.4])], np.array([0.5]))).all()
    solver = Solver()
    solver.stage(Batch((Variables("vector2", np.array([1]), np.array([[0.3, 0.4]])),), ()))
    with pytest.raises(errors.NotFinite, match="the residual of bad"):
        solver.stage(Batch((), (Factors(text, np.array([[1]]), np.array([[0.5]]), np.array([[1.0]])),)))


@pytest.mark.parametrize(
    ("body", "wanted"),
    [
        ("select(sqrt(negate(norm(a))),norm(a),add(norm(a),2))", 2.5),
        ("select(norm(a),norm(a),sqrt(negate(norm(a))))", 0.5),
        ("add(norm(a),multiply(0,part(a,0,1)))", 0.5),
        ("add(norm(a),norm(subtract(a,a)))", 0.5),
        ("add(norm(a),sqrt(subtract(norm(a),norm(a))))", 0.5),
    ],
)
def test_what_is_not_taken_does_not_matter_and_a_root_of_0_is_0(body: str, wanted: float) -> None:
    text = f"good(a:vector2,z:1)=subtract({body},z)"
    solver = Solver()
    factors = Factors(text, np.array([[1]]), np.array([[0.0]]), np.array([[1.0]]))
    solver.stage(Batch((Variables("vector2", np.array([1]), np.array([[0.3, 0.4]])),), ()))
    solver.stage(Batch((), (factors,)))
    assert code_of(read_formula(text), [np.array([0.3, 0.4])], np.zeros(1)) == pytest.approx(wanted)


def test_random_formulas_are_no_numbers_at_the_same_values() -> None:
    """With roots and quotients of anything, of zeros too."""
    none = same = 0
    for seed in range(250):
        rng = np.random.default_rng(1000 + seed)
        declared = random_formula(rng, 8)
        for _ in range(4):
            values, z = _values(declared, rng)
            with np.errstate(all="ignore"):
                wanted = evaluate(declared, values, z)
                nearby = evaluate(declared, values, z * (1.0 + 1e-14))
            found = code_of(declared, values, z)
            where = f"{write_formula(declared)} {values} {z}"
            if not np.isfinite(wanted).all():
                assert np.isnan(found).all(), where
                none += 1
            elif np.abs(wanted).max() < 1e6 and np.abs(nearby - wanted).max() < 1e-6:
                np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-7, err_msg=where)
                same += 1
    assert none > 30
    assert same > 300


def _values(declared: Declaration, rng: np.random.Generator) -> tuple[list[np.ndarray], np.ndarray]:
    found = []
    for kind in declared.types[: len(declared.variables) + 1]:
        value = random_value(kind, rng)
        found.append(value * float(rng.choice([0.0, 1.0, 10.0])) if isinstance(kind, int) else value)
    return found[:-1], found[-1]
