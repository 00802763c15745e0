"""Closures that went in with the step of their batch, as the map expected."""

from collections.abc import Iterator, Sequence
from typing import overload

from factorbus.solver.closures.choosing import PASSED
from factorbus.solver.closures.ledger import ACCEPTED, Closure
from factorbus.solver.graph.groups import FactorsLike
from factorbus.solver.kernels.jit.compile import F64


class ExpectedClosures(Sequence[Closure]):
    """All of one batch, in their order.  Each is made when one of them is asked for.

    factors, places: of each, with its place in the batch.  first: the id of the first factor of the batch.  row: of the
    first of them in the ledger.  odds (n, 3): d², the odds of the residual, and whether it is believed.
    """

    KIND = "between_se2"
    __slots__ = ("_factors", "_first", "_made", "_odds", "_places", "_revision", "_row")

    def __init__(
        self, factors: Sequence[FactorsLike], places: Sequence[int], first: int, row: int, odds: F64, revision: int
    ) -> None:
        self._factors, self._places, self._first, self._row, self._revision = factors, places, first, row, revision
        self._odds: F64 = odds
        self._made: list[Closure] | None = None

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, at: int) -> Closure: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[Closure]: ...
    def __getitem__(self, at: int | slice) -> Closure | Sequence[Closure]:
        if self._made is None:
            revision, odds = self._revision, self._odds.tolist()
            columns = zip(self._factors, self._places, odds, strict=True)
            self._made = [
                Closure(self._first + place, row, factor, revision, ACCEPTED, PASSED, d2, p, revision)
                for row, (factor, place, (d2, p, _)) in enumerate(columns, self._row)
            ]
        return self._made[at]

    def __iter__(self) -> Iterator[Closure]:
        return iter(self[:])
