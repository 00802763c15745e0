"""What a camera sees, at the door: its lens, and whether it can have seen that.  MATH §3.1."""

from functools import lru_cache

import numpy as np

from factorbus.proto.derived_kinds import RADTAN_LENSES
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.solver import errors
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factors import LENS_AT, FactorKind
from factorbus.solver.kernels.graph.admit_observations import find_lost
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import MOST_NUMBER
from factorbus.solver.lenses import layout as lens_at
from factorbus.solver.lenses.limits import limit_of

_OF_RADTAN = frozenset(RADTAN_LENSES)
# Why an observation has no pixel, or a pixel no ray.
REASONS = {
    lens_at.OUTSIDE_LENS: "beyond where the lens model is one to one",
    lens_at.VERTICAL: "its ray runs along the map's y axis, where azimuth has no meaning",
    lens_at.BEHIND: "what is seen would be behind the camera",
    lens_at.NO_FOCAL_LENGTH: "its focal length, a variable, is not above 0",
}


def with_limits(kind: FactorKind, measured: F64) -> F64:
    """A copy of measurements (m, size) with the limits of their lenses: no further out than these are one to one.

    Raises BadLens.  What is not finite, or out of bounds, is left for others to find.
    """
    start = LENS_AT[kind.name]
    lenses = measured[:, start : start + 1 + lens_at.LENS_SIZE]
    if not len(measured) or not (np.abs(lenses) <= MOST_NUMBER).all():
        return measured
    measured = measured.copy()
    different, which = lenses[:1], np.zeros(len(lenses), np.int64)
    if (lenses != lenses[0]).any():
        different, which = np.unique(lenses, axis=0, return_inverse=True)
    limits = np.array([_limit(kind.name, *row) for row in different.tolist()])
    measured[:, start + 1 + lens_at.LIMIT] = limits[which.reshape(-1)]
    return measured


def check(graph: FactorGraph, first_factor: int) -> None:
    """Are all observations from factor `first_factor` on possible where their ends are?  Raises BadObservation."""
    last = int(graph.counts[at.FACTORS])
    row, status = find_lost(True, first_factor, last, graph.var, graph.fac, graph.values, graph.payload)
    if row >= 0:
        p = int(graph.fac[row, at.F_AT])
        pixel = float(graph.payload[p]), float(graph.payload[p + 1])
        raise errors.BadObservation(graph.describe(row), pixel, REASONS[int(status)])


def inactive(graph: FactorGraph) -> list[tuple[int, str, str]]:
    """(id, the factor, why) of every observation that has no pixel at the present values."""
    found, row, last = [], -1, int(graph.counts[at.FACTORS])
    while True:
        row, status = find_lost(False, row + 1, last, graph.var, graph.fac, graph.values, graph.payload)
        if row < 0:
            return found
        found.append((int(graph.ids_of(np.array([row]))[0]), graph.describe(row), REASONS[int(status)]))


def why_inactive(graph: FactorGraph, factor: int) -> str:
    """Why the observation `factor` has no pixel at the present values; empty: it has one, or is no observation."""
    row, status = find_lost(False, factor, factor + 1, graph.var, graph.fac, graph.values, graph.payload)
    return REASONS[int(status)] if row >= 0 else ""


@lru_cache(maxsize=64)
def _limit(kind: str, code: float, fu: float, fv: float, _cx: float, _cy: float, limit: float, *more: float) -> float:
    if code not in (lens_at.RADIAL, lens_at.RADTAN, lens_at.FISHEYE):
        raise errors.BadLens(kind, f"the model {code:g}", "0 (radial), 1 (radtan) or 2 (fisheye)")
    if not (fu > 0.0 and fv > 0.0):
        raise errors.BadLens(kind, f"focal lengths {fu:g} and {fv:g}", "more than 0, pixels")
    if code == lens_at.RADIAL and not (more[0] > 0.0 and more[1] > 0.0):
        raise errors.BadLens(kind, f"a pixel of {more[0]:g} × {more[1]:g}", "sizes above 0, mm")
    if limit < 0.0:
        raise errors.BadLens(kind, f"the limit {limit:g}", "0 (as far as the model is one to one), or a radius")
    if code != lens_at.RADTAN and not _OF_RADTAN.isdisjoint(FACTOR_KINDS[kind].modifiers):
        raise errors.BadLens(kind, f"the model {code:g}", "1: what is a variable are numbers of radtan and pinhole")
    most = limit_of(int(code), more)
    return min(limit, most) if limit > 0.0 else most
