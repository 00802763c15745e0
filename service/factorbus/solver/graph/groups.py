"""What goes in and out of the solver: columns of variables and of factors, one group per kind."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from factorbus.solver.kernels.jit.compile import F64, I64


class VariablesLike(Protocol):
    """Variables of one kind that come in: keys (n,), values (n, size) or None, fixed: not estimated.

    stamps (n,): time stamps, carried and returned; `layout.NO_STAMP` of one without, None of all.
    """

    @property
    def kind(self) -> str: ...
    @property
    def keys(self) -> I64: ...
    @property
    def values(self) -> F64 | None: ...
    @property
    def fixed(self) -> bool: ...
    @property
    def stamps(self) -> I64 | None: ...


class FactorsLike(Protocol):
    """Factors of one kind that come in: keys (m, arity), measured (m, size), information (m, triangle).

    loss: one of `factors.LOSSES`, or "": rᵀ Ω r as it is; scale (m,): of a loss, in standard deviations.
    """

    @property
    def kind(self) -> str: ...
    @property
    def keys(self) -> I64: ...
    @property
    def measured(self) -> F64: ...
    @property
    def information(self) -> F64: ...
    @property
    def loss(self) -> str: ...
    @property
    def scale(self) -> F64 | None: ...


class BatchLike(Protocol):
    """Variables and factors that go in together or not at all."""

    @property
    def variables(self) -> Sequence[VariablesLike]: ...
    @property
    def factors(self) -> Sequence[FactorsLike]: ...


class Group(NamedTuple):
    """Variables of one kind with their values: keys (n,), values (n, size); stamps (n,) where any of them has one.

    A named tuple, since an estimate after every step makes them, and a frozen dataclass takes three times as long.
    """

    kind: str
    keys: I64
    values: F64
    fixed: bool = False
    stamps: I64 | None = None


class FactorGroup(NamedTuple):
    """Factors of one kind with one loss, in the order of their ids.

    keys (m, arity), measured (m, size), information (m, triangle); with a loss its scale (m,).  ids (m,), ascending.
    A named tuple as `Group` is: each loop closure that a map tests has one.
    """

    kind: str
    keys: I64
    measured: F64
    information: F64
    loss: str = ""
    scale: F64 | None = None
    ids: I64 | None = None


@dataclass(frozen=True, slots=True)
class Addition:
    """A `BatchLike` of the solver's own."""

    variables: Sequence[VariablesLike]
    factors: Sequence[FactorsLike]
