"""The kinds of factors: the wire's declaration of each, and the solver's model of it, in one.  MATH §3.

To declare a kind is told in CONTRIBUTING.md.  Tests are run for every entry of `FACTOR_KINDS`.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from factorbus.proto import inertial
from factorbus.proto import kinds as wire
from factorbus.proto.expressions.declaration import Declaration
from factorbus.solver.formulas.own_code import number_of, own_head
from factorbus.solver.graph.variables import VARIABLE_KINDS, VariableKind
from factorbus.solver.kernels.jit.compile import F64, I64
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
    own: Declaration | None = None
    kept: int = 0

    @property
    def head(self) -> F64:
        """Of an own kind: what stands before the measurement in the payload of each factor."""
        return own_head(self.own) if self.own else _NOTHING

    @property
    def before(self) -> int:
        """How many numbers these are."""
        return self.head.size

    @property
    def information_at(self) -> int:
        """Where in the payload the information begins: behind the measurement, and what is kept with that."""
        return self.before + self.size + self.kept

    @property
    def triangle(self) -> int:
        """Numbers in the upper triangle of the information matrix."""
        return self.dim * (self.dim + 1) // 2

    @property
    def width(self) -> int:
        """Numbers in the payload, but for the scale of a loss."""
        return self.information_at + self.triangle

    def __str__(self) -> str:
        return self.own.name if self.own else self.name


def _kind(kind: wire.FactorKind) -> FactorKind:
    ends = tuple(VARIABLE_KINDS[end] for end in kind.connects)
    kept = 0
    if kind.own:
        code, equation = layout.OWN, "MATH §3.11"
    elif kind.imu and kind.imu.samples:
        code, equation, kept = layout.IMU, "MATH (3.48)", inertial.KEPT
    elif kind.imu:
        code, equation = layout.PREINTEGRATED, "MATH (3.65)"
    elif kind.is_linear:
        code, equation = layout.LINEAR, "MATH (3.26)"
    else:
        code, equation = layout.FACTOR_CODES[kind.name], FACTOR_MODELS[kind.name].equation
    return FactorKind(kind.name, code, ends, kind.size, kind.dim, kind.measured, equation, kind.own, kept)


class _FactorKinds(dict[str, FactorKind]):
    """By name, as `factorbus.proto.kinds.FACTOR_KINDS`: families are found, and are not among the entries."""

    def __missing__(self, name: str) -> FactorKind:
        return _of_family(name)

    def get(self, name: str, default: Any = None) -> Any:
        """The kind of that name, or `default`."""
        return super().get(name) or (_of_family(name) if name in wire.FACTOR_KINDS else default)


@lru_cache(maxsize=1024)
def _of_family(name: str) -> FactorKind:
    return _kind(wire.FACTOR_KINDS[name])


def linear_of(rows: int, ends: tuple[int, ...]) -> FactorKind:
    """The kind of linear factors with that number of rows on variables of kinds with these codes."""
    return _of_family("_".join(["linear", str(rows), *(_VARIABLE_NAMES[code] for code in ends)]))


def imu_of(samples: int, mounted: bool, ends: int) -> FactorKind:
    """The kind of inertial factors with that number of samples and variables; mounted: the mount is one of them."""
    return _of_family(inertial.ImuForm(samples, mounted, ends > inertial.MOMENTS + mounted).name)


def imu_of_size(preintegrated: bool, ends: I64, size: int) -> FactorKind:
    """The same of variables of kinds with these codes and a measurement of that size."""
    mounted = ends.size > inertial.MOMENTS and int(ends[inertial.MOMENTS]) == layout.SE3
    one = inertial.ImuForm(1, mounted, ends.size > inertial.MOMENTS + mounted)
    return imu_of(0 if preintegrated else (size - one.start) // inertial.SAMPLE, mounted, ends.size)


@lru_cache(maxsize=64)
def kinds_by_number(names: tuple[str, ...]) -> dict[int, FactorKind]:
    """Own kinds by the number that stands in the payload of their factors."""
    kinds = [_of_family(name) for name in names]
    return {number_of(kind.own): kind for kind in kinds if kind.own}


_NOTHING: F64 = np.empty(0)
_VARIABLE_NAMES = {kind.code: name for name, kind in VARIABLE_KINDS.items()}
FACTOR_KINDS = _FactorKinds((name, _kind(kind)) for name, kind in wire.FACTOR_KINDS.items())
# Where in a measurement the code of its lens is.
LENS_AT = {name: model.lens_at for name, model in FACTOR_MODELS.items() if model.lens_at >= 0}
LOSSES = layout.LOSS_CODES
LOSS_OF_CODE = {code: name for name, code in LOSSES.items()}
# All but those of families, whose code says nothing of their sizes.
FACTOR_KIND_OF_CODE = {kind.code: kind for kind in FACTOR_KINDS.values()}
