"""The messages of wire version 1 as frozen values.  `codec` turns them into bytes and back; `proto/README.md` explains.

Arrays are columns: one array holds one field of many variables or factors of one kind.  All are C-contiguous,
little-endian float64 or int64.

What every insert is made of are named tuples: a frozen dataclass takes three times as long to make.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from factorbus.proto.arrays import F64, I64
from factorbus.proto.problems import Problem
from factorbus.proto.report import Report

# What a batch optimum may be found from: the values that the graph has, composed odometry, averaged rotations.
STARTS = ("values", "odometry", "rotations")


class Variables(NamedTuple):
    """Variables of one kind.

    keys (n,); values (n, kind.size) in the kind's order, or None: the service composes a value from the first
    factor of the same insert that reaches the variable.  fixed: not estimated (the gauge of a map).
    stamps (n,): when each was, nanoseconds of the sender's clock, NO_STAMP of one without; None: none has one.
    """

    kind: str
    keys: I64
    values: F64 | None = None
    fixed: bool = False
    stamps: I64 | None = None


class Factors(NamedTuple):
    """Factors of one kind.

    keys (m, arity) in the kind's `connects` order; measured (m, kind.size); information (m, r(r+1)/2): the upper
    triangle of the information matrix (inverse covariance) row by row, r = kind.dim.  loss: one of `kinds.LOSSES` that
    all of them have, "": none; scale (m,): of the loss, standard deviations.  ids (m,): of a whole graph, what each is
    called in changes and questions.  trusted: none of them is tested, where the map tests closures.
    """

    kind: str
    keys: I64
    measured: F64
    information: F64
    loss: str = ""
    scale: F64 | None = None
    ids: I64 | None = None
    trusted: bool = False


class Change(NamedTuple):
    """A change of what a map has: `change` is one of `kinds.CHANGES`, which says what the other fields are for.

    factors (n,): ids, `first_factor` of an Accepted and on; keys (n,): of variables.
    remove_factors    factors                    they go
    remove_variables  keys, alone                they go, and every factor on them; alone: refused if another is on them
    loss              factors, loss, scale (n,)  their loss from now on; "": none
    weigh             factors, weight (n,)       their information is multiplied by it
    fix, free         keys                       held where they are; estimated again
    marginalize       keys                       they go; what their factors say of others is kept
    accept, reject    factors                    closures that the map tests are in, or out, for good
    place             kind, keys, values, carry  variables of one kind go to these values (n, size); carry: what is not
                                                 placed by this insert goes along with what it hangs on
    """

    change: str
    factors: I64 | None = None
    keys: I64 | None = None
    loss: str = ""
    scale: F64 | None = None
    weight: F64 | None = None
    alone: bool = False
    kind: str = ""
    values: F64 | None = None
    carry: bool = False


class Batch(NamedTuple):
    """New variables and factors that go into a map together or not at all.  Also a whole graph."""

    variables: tuple[Variables, ...] = ()
    factors: tuple[Factors, ...] = ()

    @property
    def variable_count(self) -> int:
        """Number of variables over all kinds."""
        return sum(len(group.keys) for group in self.variables)

    @property
    def factor_count(self) -> int:
        """Number of factors over all kinds."""
        return sum(len(group.keys) for group in self.factors)


class Insert(NamedTuple):
    """A client's request to add `batch`; with `settle`, iterate until converged afterwards.

    convert_below: afterwards idp features whose linearity index is below this become points; 0: none do.

    sequence: 1, 2, 3, ... per client and map; the same number again gets the first answer again.
    epoch: the epoch of the map the client joined, or 0 for "whichever"; another one is refused.
    changes: made before `batch` is added, in their order; all of it happens or none.
    """

    sequence: int
    batch: Batch
    settle: bool = False
    epoch: int = 0
    convert_below: float = 0.0
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True, slots=True)
class Accepted:
    """The answer to an insert: from `revision` on the estimate includes it.

    first_factor: id of the insert's first factor; the others follow in the order of the message, which a Draft has by
    kind and loss.  factors: the ids in the order in which they were drafted; the client knows them, the wire does not.
    applied: inserts that this step took in together.  report: the step's report of work (see StepReport keys
    in `proto/README.md`): strategy, because, chi2, iterations, step_ms, ...
    """

    sequence: int
    epoch: int
    revision: int
    first_factor: int
    applied: int
    report: Mapping[str, Any] = field(default_factory=Report)
    factors: Sequence[int] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Values of variables at `revision`: all of them (answer to ask/estimate, snapshot) or those asked for."""

    epoch: int
    revision: int
    variables: tuple[Variables, ...]


@dataclass(frozen=True, slots=True)
class Delta:
    """The variables that changed from `previous` to `revision` (new ones included), bit for bit."""

    epoch: int
    revision: int
    previous: int
    variables: tuple[Variables, ...]
    report: Mapping[str, Any] = field(default_factory=Report)


@dataclass(frozen=True, slots=True)
class MapGraph:
    """A whole map at `revision`: variables with present values, factors in the order of their ids per kind."""

    epoch: int
    revision: int
    batch: Batch


@dataclass(frozen=True, slots=True)
class Chi2:
    """The answer to ask/chi2: Σ rᵀ Ω r at `revision`; `batch` is the optimum found from scratch, if asked for.

    worker: who computed the batch optimum ("in-place": the service itself); seconds: how long it took there.
    start: what led to it, one of `STARTS` ("": unknown).  notice: a BetterOptimum where the map is well above it.
    variables: the optimum itself, if it was asked for.  batch_converged: false where the search ended before it had
    converged: the optimum may be below `batch`.
    """

    epoch: int
    revision: int
    chi2: float
    batch: float | None = None
    worker: str = ""
    seconds: float = 0.0
    start: str = ""
    notice: Problem | None = None
    variables: tuple[Variables, ...] = ()
    batch_converged: bool = True


@dataclass(frozen=True, slots=True)
class Job:
    """Work for one worker: pure function of its payload, so that any worker, or two, may do it."""

    job: str
    kind: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class JobDone:
    """A worker's answer to `job`."""

    job: str
    kind: str
    payload: bytes
    seconds: float


@dataclass(frozen=True, slots=True)
class Optimum:
    """The payload that answers a job of kind `batch`: the graph optimized from scratch, its χ² and its values.

    start: what led there, one of `STARTS`; "": unknown.  converged: false where the search ended before it had.
    """

    chi2: float
    iterations: int
    variables: tuple[Variables, ...]
    start: str = ""
    converged: bool = True
