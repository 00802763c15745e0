"""Questions about uncertainty, and their answers: covariances, gates, associations, gains, repairs.  As values.

`asking_codec` and `repair_codec` turn them into bytes and back, `proto/README.md` §16 and §17 explain them.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Factors, Variables
from factorbus.proto.problems import BadSymbol, NotHeld
from factorbus.proto.symbols import format_symbol, parse_symbol
from factorbus.proto.why_text import why_symbols, why_text

BLOCKS = ("diagonal", "joint", "cross", "relative", "last")


@dataclass(frozen=True, slots=True)
class AskCovariance:
    """Which blocks of the covariance.

    blocks    diagonal: of each of `keys` (n,) by itself, None: of all variables   joint: of `keys` together
              cross: between `keys` (rows) and `others` (columns)   relative: of the pairs `keys` (n, 2), the second as
              seen from the first   last: of the pose that was inserted last
    """

    blocks: str = "diagonal"
    keys: I64 | None = None
    others: I64 | None = None


@dataclass(frozen=True, slots=True)
class CovarianceGroup:
    """Variables of one kind (or pairs whose second is): keys (n,) or (n, 2), covariance (n, d, d) in the tangent space.

    values: of pairs, (n, size): the second in the frame of the first.
    """

    kind: str
    keys: I64
    covariance: F64
    values: F64 | None = None


@dataclass(frozen=True, slots=True)
class Covariances:
    """The answer: `groups` for diagonal, last and relative; `keys`, `dims`, `covariance` for joint, whose rows are the
    tangent spaces of `keys` one after the other; for cross the same and `others`, `other_dims` for the columns.
    """

    epoch: int
    revision: int
    blocks: str
    groups: tuple[CovarianceGroup, ...] = ()
    keys: I64 | None = None
    dims: I64 | None = None
    others: I64 | None = None
    other_dims: I64 | None = None
    covariance: F64 | None = None

    def __getitem__(self, key: int | str) -> F64:
        """The covariance (d, d) of one variable, such as "x12", of a diagonal.  Raises NotHeld, a KeyError."""
        try:
            key = parse_symbol(key) if isinstance(key, str) else key
        except BadSymbol as bad:
            raise NotHeld(bad.message) from None
        for group in self.groups:
            if group.keys.ndim == 1 and (rows := (group.keys == key).nonzero()[0]).size:
                return group.covariance[rows[0]]
        raise NotHeld(f"the answer has no covariance of {format_symbol(key)}; ask for it by its key")

    def __contains__(self, key: int | str) -> bool:
        with suppress(KeyError):
            return self[key] is not None
        return False

    def __iter__(self) -> Iterator[str]:
        """The keys of a diagonal, such as "x12", in the order of the groups."""
        single = (group.keys for group in self.groups if group.keys.ndim == 1)
        return (format_symbol(key) for keys in single for key in keys.tolist())


@dataclass(frozen=True, slots=True)
class AskGate:
    """Candidate factors, and the probability with which a right one should pass."""

    factors: tuple[Factors, ...]
    probability: float = 0.95


@dataclass(frozen=True, slots=True)
class Gated:
    """For each candidate, in the order of the question: distance (n,): d², squared Mahalanobis distance; dims (n,): of
    its residual; threshold (n,): the χ² quantile; plausible (n,) bool: d² ≤ threshold.
    """

    epoch: int
    revision: int
    distance: F64
    dims: I64
    threshold: F64
    plausible: Any


@dataclass(frozen=True, slots=True)
class AskGain:
    """Candidate factors."""

    factors: tuple[Factors, ...]


@dataclass(frozen=True, slots=True)
class Gained:
    """gain (n,): ½ ln det(I + Ω H Σ Hᵀ), in nats: by how much each candidate alone would lower the map's entropy."""

    epoch: int
    revision: int
    gain: F64


@dataclass(frozen=True, slots=True)
class AskAssociate:
    """Observations from the pose `pose`, as of factors of `kind`: measured (n, size), information (n, r(r+1)/2).

    landmarks (k,): keys to choose from; None: all points of the map that the kind connects.
    """

    pose: int
    kind: str
    measured: F64
    information: F64
    landmarks: I64 | None = None
    probability: float = 0.95


@dataclass(frozen=True, slots=True)
class Associated:
    """Which landmark each observation is of, in the largest set that is compatible jointly.

    landmarks (n,): keys; matched (n,) bool: false: of none of them, and the key is 0.  distance: d² of the whole set,
    dims: of how many numbers, threshold: what it was allowed.  complete: false: the search was cut short.
    observations, candidates, distances (p,): all pairs compatible by themselves: index, key and d², nearest first.
    """

    epoch: int
    revision: int
    landmarks: I64
    matched: Any
    distance: float
    dims: int
    threshold: float
    complete: bool
    observations: I64
    candidates: I64
    distances: F64


@dataclass(frozen=True, slots=True)
class AskWhy:
    """About the variable `key`, or the factor with the id `factor`; one of them."""

    key: int | None = None
    factor: int | None = None


@dataclass(frozen=True, slots=True)
class Why:
    """variable or factor: what holds it, the other is empty; step: the report of the map's last step.  Open maps.

    `str` of it is the same in words, with keys as they print (x12).
    """

    epoch: int
    revision: int
    variable: Mapping[str, Any]
    factor: Mapping[str, Any]
    step: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The same in words: what it is, how certain, and its factors, those that fit worst first."""
        return why_text(self.revision, self.variable, self.factor, self.step)

    @property
    def symbols(self) -> tuple[str, ...]:
        """The variables that are named, as they print: the variable first, then the others of its factors."""
        return why_symbols(self.variable, self.factor)

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, slots=True)
class AskRepair:
    """Which of `factors` (n,) ids are false, None: of all that close loops.  probability: that a right one is kept.

    values: the answer is to have the repaired estimate.
    """

    factors: I64 | None = None
    probability: float = 0.99
    values: bool = False


@dataclass(frozen=True, slots=True)
class Repaired:
    """factors (n,): ids of those that are false; distance (n,): s of each at the repaired estimate.

    suspects: how many were looked at.  before, after: what the map costs as it is and repaired, each suspect no more
    than its bound.  chi2_left: χ² of all factors but the false ones, repaired.  variables: the repaired estimate, if it
    was asked for.
    """

    epoch: int
    revision: int
    factors: I64
    distance: F64
    suspects: int
    before: float
    after: float
    chi2_left: float
    seconds: float
    variables: tuple[Variables, ...] = ()
