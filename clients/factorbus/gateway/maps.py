"""The maps that somebody looks at: joined when first asked for, shared by all who look, left when the last has gone."""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from factorbus.client import Bus, Map
from factorbus.proto.messages import Graph


@dataclass(slots=True)
class Joined:
    """A map, how many look at it, and the last graph that was asked for."""

    map: Map
    lookers: int = 0
    graph: Graph | None = None
    asking: asyncio.Lock = field(default_factory=asyncio.Lock)


class Maps:
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

    async def graph(self, joined: "Joined") -> Graph:
        """Variables and factors; asked for once a revision, whoever wants them.  Raises Refused, Unavailable."""
        async with joined.asking:
            mirror, have = joined.map.estimate, joined.graph
            if have is None or (have.epoch, have.revision) != (mirror.epoch, mirror.revision):
                joined.graph = have = await asyncio.wrap_future(joined.map.ask.graph(None))
        return have

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
