"""Own kinds are computed as NumPy computes them, and their Jacobians are central differences."""

import numpy as np
import pytest
from naive.own_formulas import OWN
from naive.random_formulas import random_formula

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import difference_jacobians, evaluate, random_value
from factorbus.proto.expressions.operations import OPERATIONS
from factorbus.proto.kinds import FACTOR_KINDS, own_kind
from factorbus.service.operations.check_kind import residual_and_jacobian

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
