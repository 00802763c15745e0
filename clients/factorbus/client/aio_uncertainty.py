"""What a map can be asked about its uncertainty, for asyncio; see `factorbus.client.uncertainty`."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from factorbus.client.key_numbers import Key, as_list
from factorbus.client.uncertainty import (
    Candidates,
    UncertaintyQuestions,
    association_question,
    matrix_of,
    paired,
    why_question,
)
from factorbus.proto.arrays import F64
from factorbus.proto.asking import Associated, Covariances, Gained, Gated, Why


class Uncertainty:
    """Questions and their answers, as in `factorbus.client.uncertainty.Uncertainty`."""

    def __init__(self, ask: UncertaintyQuestions) -> None:
        self._ask = ask

    async def covariance(
        self, of: Sequence[Key] | Key | None = None, *more: Key, timeout_s: float | None = None
    ) -> Covariances:
        """The covariance of each of some variables, or of all of them."""
        return await asyncio.wrap_future(
            self._ask.covariance("diagonal", as_list("covariance", of, more), None, timeout_s)
        )

    async def last(self, timeout_s: float | None = None) -> Covariances:
        """The covariance of the pose that was inserted last."""
        return await asyncio.wrap_future(self._ask.covariance("last", None, None, timeout_s))

    async def joint(self, of: Sequence[Key] | Key, *more: Key, timeout_s: float | None = None) -> F64:
        """The joint covariance (d, d) of some variables."""
        return matrix_of(
            await asyncio.wrap_future(self._ask.covariance("joint", as_list("joint", of, more), None, timeout_s))
        )

    async def cross(
        self, rows: Sequence[Key] | Key, columns: Sequence[Key] | Key, *, timeout_s: float | None = None
    ) -> F64:
        """The covariance (d, e) between some variables and others."""
        return matrix_of(await asyncio.wrap_future(self._ask.covariance("cross", rows, columns, timeout_s)))

    async def relative(
        self, pairs: Sequence[tuple[Key, Key]] | tuple[Key, Key], *more: Any, timeout_s: float | None = None
    ) -> Covariances:
        """Of each pair, the second as seen from the first."""
        return await asyncio.wrap_future(
            self._ask.covariance("relative", paired(as_list("relative", pairs, more)), None, timeout_s)
        )

    async def gate(
        self,
        candidates: Candidates,
        probability: float = 0.95,
        *,
        timeout_s: float | None = None,
    ) -> Gated:
        """Which of the candidate factors are plausible."""
        return await asyncio.wrap_future(self._ask.gate(candidates, probability, timeout_s))

    async def gain(self, candidates: Candidates, *, timeout_s: float | None = None) -> Gained:
        """How many nats of information each candidate factor would bring by itself."""
        return await asyncio.wrap_future(self._ask.gain(candidates, timeout_s))

    async def associate(
        self,
        pose: Key,
        kind: str,
        measured: ArrayLike,
        *,
        information: ArrayLike,
        landmarks: Sequence[Key] | Key | None = None,
        probability: float = 0.95,
        timeout_s: float | None = None,
    ) -> Associated:
        """Which landmark each observation from `pose` is of, jointly."""
        ask = association_question(pose, kind, measured, information, landmarks, probability)
        return await asyncio.wrap_future(self._ask.associate(ask, timeout_s))

    async def why(self, key: Key | None = None, *, factor: int | None = None, timeout_s: float | None = None) -> Why:
        """What holds a variable, or what a factor does, and what the map's last step did and why."""
        return await asyncio.wrap_future(self._ask.why(why_question(key, factor), timeout_s))
