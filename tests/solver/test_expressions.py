"""Own kinds are computed as NumPy computes them, and their Jacobians are central differences."""

import ctypes

import numpy as np
import pytest
from naive.own_formulas import OWN
from naive.random_formulas import random_formula

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import difference_jacobians, evaluate, random_value
from factorbus.proto.expressions.formula import read_formula, write_formula
from factorbus.proto.expressions.operations import OPERATIONS, tangent_size
from factorbus.proto.kinds import FACTOR_KINDS, own_kind
from factorbus.service.operations.check_kind import residual_and_jacobian
from factorbus.solver.formulas.own_code import own_code_of
from factorbus.solver.kernels.jit.machine_code import address_of_function
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import (
    BOTH,
    CHI2,
    ERROR,
    ERROR_SIZE,
    FORCE,
    MISSED,
    ROOT,
    ROOT_WAS,
    SQUARE,
)

SEEDS = 150


def usable(declared: Declaration, rng: np.random.Generator) -> tuple[list[np.ndarray], ...] | None:
    """([values, z], [r, J]) where the expression is smooth: two steps of differences agree there; None: not found."""
    for _ in range(10):
        values = [random_value(kind, rng) for kind in declared.types[: len(declared.variables)]]
        z = random_value(declared.measured, rng)
        with np.errstate(all="ignore"):
            r = evaluate(declared, values, z)
            J, other = (np.hstack(difference_jacobians(declared, values, z, step)) for step in (1e-6, 4e-6))
        smooth = np.isfinite(r).all() and np.abs(J - other).max() <= 1e-6 * (1.0 + np.abs(J).max())
        if smooth and np.abs(r).max() < 1e4 and np.abs(J).max() < 1e4:
            return [*values, z], [r, J]
    return None


@pytest.mark.parametrize("name", OWN)
def test_the_solvers_kinds_written_anew_are_what_they_were(name: str) -> None:
    """Residuals and Jacobians to rounding."""
    own, rng = OWN[name], np.random.default_rng(len(name))
    assert own.own is not None
    for _ in range(10):
        *values, z = (random_value(kind, rng) for kind in own.own.types[: len(own.connects) + 1])
        z = np.abs(z) if name.startswith(("range", "bearing_range")) else z
        (r, J), (usual_r, usual_J) = (residual_and_jacobian(kind, values, z) for kind in (own, FACTOR_KINDS[name]))
        np.testing.assert_allclose(r, usual_r, rtol=0, atol=1e-12)
        np.testing.assert_allclose(J, usual_J, rtol=0, atol=1e-12)


def test_random_expressions_are_what_numpy_computes() -> None:
    used = set[str]()
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        while (found := usable(declared := random_formula(rng), rng)) is None:
            pass
        (*values, z), (r, J) = found
        value, slope = residual_and_jacobian(own_kind(declared), values, z)
        np.testing.assert_allclose(value, r, rtol=1e-10, atol=1e-10, err_msg=str(seed))
        np.testing.assert_allclose(slope, J, rtol=0, atol=1e-6 * (1.0 + np.abs(J).max()), err_msg=str(seed))
        used |= {node.operation for node in declared.nodes}
    assert used >= set(OPERATIONS)


def test_how_far_random_expressions_are_from_a_linear_model_is_what_numpy_computes() -> None:
    """With any r, J before, weights of a loss and variables that are fixed.  MATH (9.11), (9.31)"""
    many_rows = read_formula("many_rows(a:se3,b:vector9,z:1)=vector(log(a),b,log(compose(a,a)),subtract(norm(b),z))")
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        while (found := usable(declared := random_formula(rng) if seed % 5 else many_rows, rng)) is None:
            pass
        (*values, z), _ = found
        r, J = residual_and_jacobian(own_kind(declared), values, z)
        dim, columns = J.shape
        sizes = [tangent_size(kind) for kind in declared.types[: len(values)]]
        fixed = rng.random(len(sizes)) < 0.2
        free = np.repeat(~fixed, sizes)
        delta, W = rng.normal(size=columns), rng.normal(size=(dim, dim))
        weight, (root, root_was) = W @ W.T + np.eye(dim), rng.uniform(0.2, 1.0, 2)
        was, J_was = r + rng.normal(size=dim), J + rng.normal(size=J.shape)

        found_error, out = asked_of(declared, [*values, z], fixed, ERROR, (was, J_was, weight, delta, root, root_was))
        assert found_error == BOTH
        np.testing.assert_allclose(out[:dim], r, rtol=0, atol=1e-9)
        told = out[dim:]
        missed = root * r - root_was * (was + J_was[:, free] @ delta[free])
        turned = (root * J - root_was * J_was).T @ weight @ (root * r)
        held = np.diag((root * J).T @ weight @ (root * J))
        shares = np.divide(turned**2, held, out=np.zeros(columns), where=held > 0)
        assert told[CHI2] == pytest.approx(r @ weight @ r, rel=1e-10)
        assert told[MISSED] == pytest.approx(missed @ weight @ missed, rel=1e-10)
        assert told[FORCE] == pytest.approx(shares[free].sum(), rel=1e-8)
        bits, _ = asked_of(declared, [*values, z], fixed, SQUARE, (was, J_was, weight, delta, root, root_was))
        assert np.int64(bits).view(np.float64) == pytest.approx(r @ weight @ r, rel=1e-10)


def asked_of(declared, values, fixed, what: int, linear) -> tuple[int, np.ndarray]:
    """What the machine code of a kind gives, and what it has written."""
    (was, J_was, weight, delta, root, root_was), count = linear, len(values) - 1
    code, x, var = own_code_of(write_formula(declared)), np.concatenate(values), np.zeros((count, at.V_WIDTH), np.int64)
    var[:, at.V_AT] = np.cumsum([0, *map(len, values[:-2])])
    sizes = [tangent_size(kind) for kind in declared.types[:count]]
    var[:, at.V_SCALAR] = np.where(fixed, -1, np.cumsum([0, *sizes[:-1]]))
    fac = np.zeros((max(count - 1, 1), at.F_WIDTH), np.int64)
    fac[: count - 1, at.F_J] = np.arange(1, count)
    upper = np.ascontiguousarray(weight[np.triu_indices(len(was))])
    kept = np.concatenate((was, J_was.ravel(), np.full(8, np.nan)))
    out = np.full(len(was) + ERROR_SIZE, np.nan)
    out[len(was) + ROOT], out[len(was) + ROOT_WAS] = root, root_was
    arrays = [x, var, fac, np.asarray(values[-1], float), out]
    words = [array.ctypes.data for array in arrays] + [what] + [array.ctypes.data for array in (kept, upper, delta)]
    function = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * len(words))
    return function(address_of_function(code.number))(*words), out
