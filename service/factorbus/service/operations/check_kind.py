"""An own kind's Jacobian as the solver computes it, beside central differences of its residual in NumPy."""

from dataclasses import dataclass

import numpy as np

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.evaluate import difference_jacobians, evaluate, random_value
from factorbus.proto.kinds import FactorKind, own_kind
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import Addition, FactorGroup, Group
from factorbus.solver.graph.linearized import linearized_factor

_WANTED, _TRIES = 20, 200
_STEPS = 1e-6, 4e-6  # of differences; where they differ there is an edge, and no slope


@dataclass(frozen=True, slots=True)
class Comparison:
    """tried: at how many values.  difference: the largest of any entry, of r too, as a share of the largest entry."""

    tried: int
    difference: float


def largest_difference(declared: Declaration) -> Comparison | None:
    """None: its residual is no number, or has no slope, at any of the values tried."""
    rng, tried, worst = np.random.default_rng(1), 0, 0.0
    for _ in range(_TRIES):
        *values, z = (random_value(kind, rng) for kind in declared.types[: len(declared.variables) + 1])
        with np.errstate(all="ignore"):
            r = evaluate(declared, values, z)
            J, other = (np.hstack(difference_jacobians(declared, values, z, step)) for step in _STEPS)
        most = 1.0 + float(np.abs(J).max())
        if not (np.isfinite(r).all() and np.abs(J - other).max() <= 1e-6 * most):
            continue
        found, slopes = residual_and_jacobian(own_kind(declared), values, z)
        worst = max(worst, float(np.abs(found - r).max()) / (1.0 + float(np.abs(r).max())))
        worst = max(worst, float(np.abs(slopes - J).max()) / most)
        tried += 1
        if tried == _WANTED:
            break
    return Comparison(tried, worst) if tried else None


def residual_and_jacobian(kind: FactorKind, values: list[np.ndarray], z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """r and [∂r/∂x₁ …] of any kind as the solver has them.  Raises SolverError: they are no numbers."""
    graph = FactorGraph()
    ends = enumerate(zip(kind.connects, values, strict=True))
    variables = tuple(Group(end, np.array([n]), x[None]) for n, (end, x) in ends)
    information = np.eye(kind.dim)[np.triu_indices(kind.dim)][None]
    admit(graph, Addition(variables, (FactorGroup(kind.name, np.arange(len(values))[None], z[None], information),)))
    found = linearized_factor(graph, 0)
    return found.r, found.J
