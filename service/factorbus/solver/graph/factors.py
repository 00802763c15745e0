"""The kinds of factors: the wire's declaration of each, and the solver's model of it, in one.  MATH §3.

To declare a kind is told in CONTRIBUTING.md.  Tests are run for every entry of `FACTOR_KINDS`.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from factorbus.proto import inertial
from factorbus.proto import kinds as wire
from factorbus.solver.graph.variables import VARIABLE_KINDS, VariableKind
from factorbus.solver.kernels.model import layout
from factorbus.solver.kernels.model.kinds import FACTOR_MODELS


@dataclass(frozen=True, slots=True)
class FactorKind:
    """One kind of factor: `size` numbers measured, a residual of `dim`, an information matrix dim × dim.

    name: the wire name, whose meaning never changes.  code: how kernels know it.
    kept: numbers that the graph keeps behind a measurement, which follow from it.
    """

    name: str
    code: int
    connects: tuple[VariableKind, ...]
    size: int
    dim: int
    measures: str
    equation: str
    kept: int = 0

    @property
    def stored(self) -> int:
        """Numbers in front of the information in the graph: measured, and kept."""
        return self.size + self.kept

    @property
    def triangle(self) -> int:
        """Numbers in the upper triangle of the information matrix."""
        return self.dim * (self.dim + 1) // 2

    @property
    def width(self) -> int:
        """Numbers of a factor in the graph, without the scale of a loss."""
        return self.stored + self.triangle

    def __str__(self) -> str:
        return self.name


def _kind(kind: wire.FactorKind) -> FactorKind:
    ends = tuple(VARIABLE_KINDS[end] for end in kind.connects)
    code, equation, kept = layout.LINEAR, "MATH (3.26)", 0
    if kind.samples:
        code, equation, kept = layout.IMU, "MATH (3.55)", inertial.KEPT
    elif not kind.is_linear:
        code, equation = layout.FACTOR_CODES[kind.name], FACTOR_MODELS[kind.name].equation
    return FactorKind(kind.name, code, ends, kind.size, kind.dim, kind.measured, equation, kept)


class _FactorKinds(dict[str, FactorKind]):
    """By name, as `factorbus.proto.kinds.FACTOR_KINDS`: linear and inertial ones are found, and are
    not among the entries."""

    def __missing__(self, name: str) -> FactorKind:
        return _of_name(name)

    def get(self, name: str, default: Any = None) -> Any:
        """The kind of that name, or `default`."""
        return super().get(name) or (_of_name(name) if name in wire.FACTOR_KINDS else default)


@lru_cache(maxsize=1024)
def _of_name(name: str) -> FactorKind:
    return _kind(wire.FACTOR_KINDS[name])


def linear_of(rows: int, ends: tuple[int, ...]) -> FactorKind:
    """The kind of linear factors with that number of rows on variables of kinds with these codes."""
    return _of_name("_".join(["linear", str(rows), *(_VARIABLE_NAMES[code] for code in ends)]))


def imu_of(samples: int) -> FactorKind:
    """The kind of inertial factors with that number of samples."""
    return _of_name(inertial.name_of(samples))


_VARIABLE_NAMES = {kind.code: name for name, kind in VARIABLE_KINDS.items()}
FACTOR_KINDS = _FactorKinds((name, _kind(kind)) for name, kind in wire.FACTOR_KINDS.items())
# Where in a measurement the code of its lens is.
LENS_AT = {name: model.lens_at for name, model in FACTOR_MODELS.items() if model.lens_at >= 0}
LOSSES = layout.LOSS_CODES
LOSS_OF_CODE = {code: name for name, code in LOSSES.items()}
# All but linear and inertial ones, whose code says nothing of their sizes.
FACTOR_KIND_OF_CODE = {kind.code: kind for kind in FACTOR_KINDS.values()}
