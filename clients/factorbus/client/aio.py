"""The client for asyncio: the same maps, mirror and guarantees; what waits is awaited.

    async with connect("tcp/127.0.0.1:7447", client="robot1") as bus, bus.map("kitchen") as kitchen:
        await kitchen.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        async for delta in kitchen.deltas():
            ...

Answers come from the bus's threads straight into futures of the loop; only connecting, joining and leaving, which
are rare, and putting large covariances together borrow a thread of the loop's executor.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from os import PathLike
from typing import Any

from numpy.typing import ArrayLike

from factorbus.client import bus as sync
from factorbus.client.aio_uncertainty import Uncertainty
from factorbus.client.arguments import checked_seconds, of_type
from factorbus.client.changes import Changes, some_of
from factorbus.client.draft import Draft
from factorbus.client.features import Features as SyncFeatures
from factorbus.client.filter_state import Factored, FilterState
from factorbus.client.key_numbers import Key, as_list
from factorbus.client.map import Map as SyncMap
from factorbus.client.map_row import MapRow
from factorbus.client.merging import Merged, fit_into
from factorbus.client.mirror import Mirror
from factorbus.client.pending_insert import NoAnswerYet, PendingInsert
from factorbus.client.questions import logged
from factorbus.client.renaming_kinds import saying_how_to_rename
from factorbus.client.smoothed_poses import BlendedPose
from factorbus.client.stream import DeltaStream
from factorbus.proto.asking import Repaired
from factorbus.proto.camera import Camera
from factorbus.proto.closures import Suspects
from factorbus.proto.components import Components
from factorbus.proto.interest import Interest
from factorbus.proto.messages import Accepted, Batch, Chi2, Delta, Estimate, MapGraph


@asynccontextmanager
async def connect(
    endpoint: str | Sequence[str],
    *,
    client: str = "client",
    timeout_s: float = 10.0,
    settings: Mapping[str, Any] | None = None,
    zenoh: str | PathLike[str] = "",
) -> AsyncIterator[Bus]:
    """As `factorbus.client.connect`, in `async with`."""
    bus = await asyncio.to_thread(
        sync.connect, endpoint, client=client, timeout_s=timeout_s, settings=settings, zenoh=zenoh
    )
    try:
        yield Bus(bus)
    finally:
        await asyncio.to_thread(bus.close)


class Bus:
    """A connection to the bus."""

    def __init__(self, bus: sync.Bus) -> None:
        self._bus = bus

    @asynccontextmanager
    async def map(
        self,
        name: str,
        mode: str = "auto",
        *,
        window: int = 32,
        mirror: bool = True,
        create: bool = True,
        interest: Interest | None = None,
        closures: str | None = None,
    ) -> AsyncIterator[Map]:
        """As `factorbus.client.Bus.map`, in `async with`; leaving it waits for what was sent."""
        how = {"window": window, "mirror": mirror, "create": create, "interest": interest, "closures": closures}
        joined = await asyncio.to_thread(self._bus.map, name, mode, **how)
        try:
            here = Map(joined, window)
            yield here
            await here.flush()
        finally:
            await asyncio.to_thread(joined.close, quietly=True)

    @asynccontextmanager
    async def features(self, camera: Camera, **prior: Any) -> AsyncIterator[Features]:
        """As `factorbus.client.Bus.features`, in `async with`."""
        front = self._bus.features(camera, **prior)
        try:
            yield Features(front)
        finally:
            front.close()

    async def maps(self) -> list[MapRow]:
        """The maps there are.  Raises Refused, Unavailable."""
        return await asyncio.to_thread(self._bus.maps)

    async def stats(self) -> list[dict[str, Any]]:
        """What each service counts and times.  Raises Refused, Unavailable."""
        return await asyncio.to_thread(self._bus.stats)

    async def create(
        self,
        name: str,
        mode: str = "auto",
        *,
        closures: str | None = None,
        budget_ms: float | None = None,
        keep: str | Mapping[str, Any] | None = None,
    ) -> MapRow:
        """Create map `name`, or find it as it is.  Raises Refused, Unavailable, BadName, BadOption, NotSupported."""
        return await asyncio.to_thread(self._bus.create, name, mode, closures=closures, budget_ms=budget_ms, keep=keep)

    async def set_budget(self, name: str, budget_ms: float | None) -> MapRow:
        """Give the steps of map `name` another budget; None: no bound.  Raises as `factorbus.client.Bus.set_budget`."""
        return await asyncio.to_thread(self._bus.set_budget, name, budget_ms)

    async def fork(self, name: str, target: str) -> MapRow:
        """A new map that begins as `name` is now.  Raises as `factorbus.client.Bus.fork`."""
        return await asyncio.to_thread(self._bus.fork, name, target)

    async def drop(self, name: str, *, missing_ok: bool = False) -> None:
        """Drop map `name` and everything in it; as `Bus.drop`.  Raises Refused, Unavailable, BadName, UnknownMap."""
        await asyncio.to_thread(self._bus.drop, name, missing_ok=missing_ok)


class Features:
    """Where a filter has its features made; see `factorbus.client.Features`."""

    def __init__(self, front: SyncFeatures) -> None:
        self._front = front

    async def grow(
        self, x: ArrayLike, P: ArrayLike, pixels: ArrayLike, *, timeout_s: float | None = None
    ) -> FilterState:
        """State and covariance with a new feature for each pixel.  Raises as `factorbus.client.Features.grow`."""
        growing = await asyncio.to_thread(self._front.send, x, P, pixels, timeout_s=timeout_s)
        return await asyncio.to_thread(growing.result)

    async def factor(
        self, x: ArrayLike, P: ArrayLike, pixels: ArrayLike, *, timeout_s: float | None = None
    ) -> Factored:
        """The new features as factors.  Raises as `factorbus.client.Features.grow`."""
        return await asyncio.to_thread(self._front.factor, x, P, pixels, timeout_s=timeout_s)


class Map:
    """A map that this client has joined; see `factorbus.client.Map` for what it promises."""

    def __init__(self, joined: SyncMap, window: int) -> None:
        self._map = joined
        self._room = asyncio.Semaphore(window)
        self._loop = asyncio.get_running_loop()
        self.uncertainty = Uncertainty(joined.uncertainty.ask)
        self.marginals = self.uncertainty

    @property
    def name(self) -> str:
        """The map's name."""
        return self._map.name

    @property
    def epoch(self) -> int:
        """The epoch that was joined."""
        return self._map.epoch

    @property
    def estimate(self) -> Mirror:
        """The live estimate; reading it never waits.  Raises Unavailable for a map opened with mirror=False."""
        return self._map.estimate

    def pose(self, key: Key, smooth_s: float = 0.0) -> BlendedPose:
        """The pose of a variable with corrections blended, as `factorbus.client.Map.pose`; it never waits."""
        return self._map.pose(key, smooth_s)

    async def insert(
        self,
        batch: Batch | Draft,
        *,
        settle: bool = False,
        convert_below: float = 0.0,
        changes: Changes | None = None,
        timeout_s: float | None = None,
    ) -> Accepted:
        """Make `changes`, add `batch` and wait for the answer.  Raises Refused, NoAnswerYet (an Unavailable)."""
        timeout_s = checked_seconds("timeout_s", timeout_s, self._map.timeout_s)  # refused before anything is sent
        sent = await self.send(batch, settle=settle, convert_below=convert_below, changes=changes)
        return await self.result(sent, timeout_s)

    async def settle(self, timeout_s: float | None = None) -> Accepted:
        """Have the map iterate until it has converged.  Raises Refused, NoAnswerYet."""
        return await self.insert(Batch(), settle=True, timeout_s=timeout_s)

    async def change(self, changes: Changes, *, settle: bool = False, timeout_s: float | None = None) -> Accepted:
        """Change what the map has: remove, weigh, fix, ...  Raises Refused, NoAnswerYet."""
        return await self.insert(Batch(), changes=some_of(changes), settle=settle, timeout_s=timeout_s)

    async def merge(
        self,
        other: MapGraph | Map,
        *,
        anchors: Batch | Draft | None = None,
        frame: ArrayLike | None = None,
        sigmas: ArrayLike | None = None,
        letters: Mapping[str, str] | None = None,
        absolute: str = "refuse",
        settle: bool = False,
        timeout_s: float | None = None,
    ) -> Merged:
        """Take all of the map `other` into this one, as `factorbus.client.Map.merge`."""
        if not isinstance(other, MapGraph):
            other = await of_type("other", other, Map, "a Map, or the MapGraph of one").graph(timeout_s)
        fitted = fit_into(
            await self.ask_estimate(timeout_s=timeout_s), other,
            anchors=anchors, frame=frame, sigmas=sigmas, letters=letters, absolute=absolute,
        )  # fmt: skip
        with saying_how_to_rename():
            return Merged(await self.insert(fitted.batch, settle=settle, timeout_s=timeout_s), fitted)

    async def send(
        self,
        batch: Batch | Draft,
        *,
        settle: bool = False,
        convert_below: float = 0.0,
        changes: Changes | None = None,
    ) -> PendingInsert:
        """Send `batch`; waits only while the window is full."""
        await self._room.acquire()
        try:
            pending_insert = self._map.send(batch, settle=settle, convert_below=convert_below, changes=changes)
        except BaseException:
            self._room.release()
            raise
        pending_insert.request.future.add_done_callback(lambda _: self._on_loop(self._room.release))
        return pending_insert

    async def result(self, pending_insert: PendingInsert, timeout_s: float | None = None) -> Accepted:
        """The answer to what was sent.  Raises Refused, NoAnswerYet."""
        timeout_s = checked_seconds("timeout_s", timeout_s, self._map.timeout_s)
        try:
            return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(pending_insert.future)), timeout_s)
        except TimeoutError:
            raise NoAnswerYet(pending_insert, timeout_s) from None

    async def flush(self, timeout_s: float | None = None) -> None:
        """Wait until everything sent is answered.  Raises Unavailable, and the first refusal nobody has looked at."""
        await asyncio.to_thread(self._map.flush, timeout_s)

    async def rejoin(self) -> int:
        """Join the map as it is now and return its epoch; numbering starts again."""
        return await asyncio.to_thread(self._map.rejoin)

    async def ask_estimate(
        self, of: Sequence[Key] | Key | None = None, *more: Key, timeout_s: float | None = None
    ) -> Estimate:
        """Values from the service at one revision: all, or of some variables.  Raises Refused, Unavailable."""
        return await asyncio.wrap_future(self._map.ask.estimate(as_list("ask_estimate", of, more), timeout_s))

    async def chi2(self, batch: bool = False, *, timeout_s: float | None = None, values: bool = False) -> Chi2:
        """Σ rᵀΩr of the estimate, and of the optimum from scratch, as `factorbus.client.Map.chi2`."""
        return await asyncio.wrap_future(self._map.ask.chi2(batch, timeout_s, values))

    async def repair(
        self, factors: Sequence[int] | int | None = None, *, probability: float = 0.99, timeout_s: float | None = None
    ) -> Repaired:
        """Which factors are false, as in `factorbus.client.Map.repair`.  Raises Refused, Unavailable."""
        return await asyncio.wrap_future(self._map.ask.repair(factors, probability, timeout_s))

    async def suspects(self, every: bool = False, *, timeout_s: float | None = None) -> Suspects:
        """Loop closures that the estimate does not have, as in `factorbus.client.Map.suspects`.

        Raises Refused, Unavailable.
        """
        return await asyncio.wrap_future(self._map.ask.suspects(every, timeout_s))

    async def components(self, timeout_s: float | None = None) -> Components:
        """Which parts of the map no factor joins, as in `factorbus.client.Map.components`.

        Raises Refused, Unavailable.
        """
        return await asyncio.wrap_future(self._map.ask.components(timeout_s))

    async def graph(self, timeout_s: float | None = None) -> MapGraph:
        """The whole map: variables with present values, and factors.  Raises Refused, Unavailable."""
        return await asyncio.wrap_future(self._map.ask.graph(timeout_s))

    async def stats(self, timeout_s: float | None = None) -> dict[str, Any]:
        """What the service counts and times about this map.  Raises Refused, Unavailable."""
        return await asyncio.wrap_future(self._map.ask.stats(timeout_s))

    async def clients(self, timeout_s: float | None = None) -> set[str]:
        """Names of the clients that have joined the map and not left it, of those that tell."""
        return await asyncio.to_thread(self._map.clients, timeout_s)

    async def export(
        self,
        format: str = "g2o",
        *,
        timeout_s: float | None = None,
        robot: str | None = None,
        strict: bool = False,
        ids: str = "auto",
    ) -> str:
        """The map as the text of a file: "g2o", "pyfg", "jrl", "tum" or "kitti", as in `Map.export`.

        Raises Refused, Unavailable.
        """
        exported = await asyncio.wrap_future(self._map.ask.export(format, timeout_s, robot, strict, ids))
        return logged(self._map.name, exported)

    async def wait_for(self, revision: int, timeout_s: float | None = None) -> None:
        """Until the mirror is at `revision` or later and not stale.  Raises Unavailable."""
        await asyncio.to_thread(self.estimate.wait_for, revision, timeout_s)

    async def wait_converged(self, timeout_s: float | None = None) -> None:
        """Until the map, left alone, has converged, as `factorbus.client.Map.wait_converged`.

        Raises NotConverged, and as `flush` does.
        """
        await asyncio.to_thread(self._map.wait_converged, timeout_s)

    async def deltas(self) -> AsyncIterator[Delta]:
        """Every change of the estimate from now on, without end.

        A delta whose `previous` is 0 holds the whole estimate: after a resynchronization, or when this loop fell
        too far behind.
        """
        ready = asyncio.Event()
        stream = DeltaStream(self.estimate, lambda: self._on_loop(ready.set))
        try:
            while True:
                await ready.wait()
                ready.clear()
                while (delta := stream.try_take()) is not None:
                    yield delta
        finally:
            stream.close()

    def _on_loop(self, call: Callable[..., Any], *arguments: Any) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(call, *arguments)
