"""Steps of a map to a browser: the whole estimate first, then what changed, as fast as the browser takes it.

Steps that come while a message is under way are sent together, each variable once: who is slow gets fewer messages and
misses none of the values.  A map that is no more, or a service that is silent, is reported as well: what a person
looks at is never old without a word.
"""

import asyncio
from collections.abc import Iterable
from typing import Any

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect

from factorbus.client import Mirror
from factorbus.client.stream import DeltaStream
from factorbus.gateway.documents import estimate, groups, plain
from factorbus.proto.messages import Delta, Variables
from factorbus.proto.stamps import NO_STAMP

_LEAST_PAUSE_S = 0.05
# How often it is looked whether the values are old; shorter than that they may be while a step is on its way.
_LOOK_S, _OLD_S = 1.0, 2.0


async def follow_map(socket: WebSocket, mirror: Mirror) -> None:
    """Send until the browser leaves.  `socket` is accepted already."""
    loop, news = asyncio.get_running_loop(), asyncio.Event()

    def wake() -> None:
        loop.call_soon_threadsafe(news.set)

    stream = DeltaStream(mirror, wake)
    leaving = asyncio.ensure_future(_leaves(socket))
    try:
        snapshot = mirror.snapshot()
        report = {"converging": True} if mirror.converging else {}
        await _send(socket, {"type": "estimate", **estimate(snapshot), "report": report})
        at = (snapshot.epoch, snapshot.revision)
        was_old = False
        while not leaving.done():
            waiting = asyncio.ensure_future(news.wait())
            await asyncio.wait((waiting, leaving), timeout=_LOOK_S, return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            news.clear()
            old = mirror.stale and (was_old or mirror.age_s > _OLD_S)
            if old != was_old:
                was_old = old
                await _send(socket, {"type": "state", "stale": old, "revision": at[1]})
            deltas = [d for d in iter(stream.try_take, None) if d.epoch != at[0] or d.revision > at[1]]
            if deltas:
                at = (deltas[-1].epoch, deltas[-1].revision)
                await _send(socket, _together(deltas))
                await asyncio.sleep(_LEAST_PAUSE_S)
    except WebSocketDisconnect:
        pass
    finally:
        leaving.cancel()
        stream.close()


async def _send(socket: WebSocket, document: dict[str, Any]) -> None:
    """Raises WebSocketDisconnect when the browser has left, or was closed for what it sent: the server says that so."""
    try:
        await socket.send_json(document)
    except RuntimeError as closed:
        raise WebSocketDisconnect(1006) from closed


async def _leaves(socket: WebSocket) -> None:
    """Returns when the browser has closed the connection; whatever it says is not listened to."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


def _together(deltas: list[Delta]) -> dict[str, Any]:
    """Deltas that follow each other as one message: from the last that brings everything on, if there is one."""
    whole = max((i for i, delta in enumerate(deltas) if not delta.previous), default=None)
    used = deltas if whole is None else deltas[whole:]
    last = used[-1]
    return {
        "type": "delta" if whole is None else "estimate",
        "epoch": str(last.epoch),
        "revision": last.revision,
        "previous": used[0].previous,
        "steps": len(used),
        "variables": groups(_latest(used)),
        "report": plain(last.report),
    }


def _latest(deltas: Iterable[Delta]) -> list[Variables]:
    """The last value of each variable, by kind, and its time stamp."""
    found: dict[str, dict[int, Any]] = {}
    stamps: dict[int, int] = {}
    for delta in deltas:
        for group in delta.variables:
            if group.values is not None:
                found.setdefault(group.kind, {}).update(zip(group.keys.tolist(), group.values, strict=True))
            if group.stamps is not None:
                stamps.update(zip(group.keys.tolist(), group.stamps.tolist(), strict=True))
    return [_group(kind, rows, stamps) for kind, rows in found.items()]


def _group(kind: str, rows: dict[int, Any], stamps: dict[int, int]) -> Variables:
    own = np.array([stamps.get(key, NO_STAMP) for key in rows], np.int64)
    known = own if (own != NO_STAMP).any() else None
    return Variables(kind, np.array(list(rows)), np.array(list(rows.values())), stamps=known)
