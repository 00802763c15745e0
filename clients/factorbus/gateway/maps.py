"""The maps that somebody looks at: joined when first asked for, shared by all who look, left when the last has gone."""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from factorbus.client import Bus, Map
from factorbus.proto.asking import Covariances
from factorbus.proto.messages import MapGraph
from factorbus.viz import Spread, spread_of
from factorbus.viz.certainty import blocks_of, chosen

_ELLIPSES = 60  # at most, of poses and of points alike


@dataclass(slots=True)
class Joined:
    """A map, how many look at it, the last graph that was asked for, and the last covariances."""

    map: Map
    lookers: int = 0
    graph: MapGraph | None = None
    covariances: Covariances | None = None
    asking: asyncio.Lock = field(default_factory=asyncio.Lock)


class JoinedMaps:
    """Joined maps by name.  `using` may be called from any thread; what it gives is used in the event loop."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self._joined: dict[str, Joined] = {}
        self._lock = threading.Lock()

    @asynccontextmanager
    async def using(self, name: str) -> AsyncIterator["Joined"]:
        """Map `name`, joined while inside.  Raises UnknownMap, BadName, Unavailable."""
        joined = await asyncio.to_thread(self._enter, name)
        try:
            yield joined
        finally:
            await asyncio.to_thread(self._leave, name, joined)

    async def graph(self, joined: "Joined") -> MapGraph:
        """Variables and factors; asked for once a revision, for all clients.  Raises Refused, Unavailable."""
        async with joined.asking:
            mirror, have = joined.map.estimate, joined.graph
            if have is None or (have.epoch, have.revision) != (mirror.epoch, mirror.revision):
                joined.graph = have = await asyncio.wrap_future(joined.map.ask.graph(None))
        return have

    async def spread(self, joined: "Joined") -> tuple[int, Spread]:
        """The revision, and where some variables may be in it; asked for once.  Raises Refused, Unavailable."""
        async with joined.asking:
            snapshot, have = joined.map.estimate.snapshot(), joined.covariances
            variables = snapshot.variables()
            if have is None or (have.epoch, have.revision) != (snapshot.epoch, snapshot.revision):
                keys = chosen(variables, _ELLIPSES).tolist()
                asked = joined.map.uncertainty.ask.covariance("diagonal", keys, None, None)
                joined.covariances = have = await asyncio.wrap_future(asked)
        return have.revision, spread_of(variables, blocks_of(have))

    def _enter(self, name: str) -> "Joined":
        with self._lock:
            joined = self._joined.get(name)
            if joined is None:
                joined = self._joined[name] = Joined(self.bus.map(name, create=False))
            joined.lookers += 1
            return joined

    def _leave(self, name: str, joined: "Joined") -> None:
        with self._lock:
            joined.lookers -= 1
            if not joined.lookers:
                del self._joined[name]
                joined.map.close()
