"""Editing over HTTP: who asks, what was edited, what there is to select, and edits themselves."""

import asyncio
import math
from collections.abc import Awaitable, Callable

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from factorbus.gateway.documents import Document
from factorbus.gateway.edit_requests import read_edit
from factorbus.gateway.editing import Editing
from factorbus.gateway.explain import explain_factor
from factorbus.gateway.guard import Guard, read_body
from factorbus.gateway.maps import JoinedMaps
from factorbus.proto.asking import AskWhy
from factorbus.proto.kinds import name_of_kind
from factorbus.proto.problems import BadOption
from factorbus.proto.symbols import format_symbol


def editing_routes(one: str, maps: JoinedMaps, guard: Guard) -> list[Route]:
    """Below `one`, the address of a map."""
    routes = _EditRoutes(maps, guard)
    answers: dict[str, tuple[Callable[[Request], Awaitable[Response]], str]] = {
        "session": (routes.session, "GET"),
        "edits": (routes.edits, "GET"),
        "edges": (routes.edges, "GET"),
        "suspects": (routes.suspects, "GET"),
        "factors/{id}": (routes.factor, "GET"),
    }
    listed = [Route(f"{one}/{path}", answer, methods=[method]) for path, (answer, method) in answers.items()]
    # The method decides: GET tells, POST edits; a route of both would have to look at it.
    return [Route(f"{one}/edits", routes.edit, methods=["POST"]), *listed]


class _EditRoutes:
    def __init__(self, maps: JoinedMaps, guard: Guard) -> None:
        self._maps, self._guard, self._editing = maps, guard, Editing(maps)

    async def session(self, request: Request) -> Response:
        """Who asks, whether they may edit this map, if not why; token: to be sent with edits."""
        person = self._guard.person(request)
        why = await self._editing.why_not(person, request.path_params["name"])
        told = {"name": person.name, "role": person.role, "may_edit": not why, "why": why}
        return Document(told | {"token": self._guard.secret, "people": bool(self._guard.people.listed)})

    async def edits(self, request: Request) -> Response:
        """What was edited through this gateway."""
        return Document((await self._editing.log(request.path_params["name"])).document())

    async def edit(self, request: Request) -> Response:
        """One edit."""
        person = self._guard.editor(request)
        edit = read_edit(await read_body(request))
        return Document(await self._editing.edit(request.path_params["name"], person, edit))

    async def edges(self, request: Request) -> Response:
        """Which factor is between which variables."""
        async with self._maps.using(request.path_params["name"]) as joined:
            graph = await self._maps.graph(joined)
        groups = [
            {
                "kind": name_of_kind(group.kind),
                "ids": group.ids.tolist(),
                "keys": [[format_symbol(key) for key in row] for row in group.keys.tolist()],
            }
            for group in graph.batch.factors
            if group.ids is not None
        ]
        fixed = [format_symbol(key) for g in graph.batch.variables if g.fixed for key in g.keys.tolist()]
        return Document({"revision": graph.revision, "factors": groups, "fixed": fixed})

    async def suspects(self, request: Request) -> Response:
        """Loop closures that the estimate does not have, of a map that tests them."""
        async with self._maps.using(request.path_params["name"]) as joined:
            found = await asyncio.wrap_future(joined.map.ask.suspects(False, None))
        listed = [
            {
                "id": factor,
                "kind": name_of_kind(found.kinds[k]),
                "keys": [format_symbol(key) for key in found.keys[k].tolist()],
                "state": found.states[k],
                "reason": found.reasons[k],
                "distance": _told(float(found.distance[k])),
                "chance": _told(float(found.chance[k])),
                **({} if found.weight is None else {"weight": _told(float(found.weight[k]))}),
                "since": int(found.changed[k]),
            }
            for k, factor in enumerate(found.factors.tolist())
        ]
        return Document({"revision": found.revision, "policy": found.policy, "closures": listed})

    async def factor(self, request: Request) -> Response:
        """What one factor says, and how it fits."""
        text = request.path_params["id"]
        if not (text.isascii() and text.isdecimal() and len(text) < 16):
            raise BadOption("factor", f"{text!r:.60}", "its id, a whole number")
        async with self._maps.using(request.path_params["name"]) as joined:
            graph = await self._maps.graph(joined)
            why = await asyncio.wrap_future(joined.map.uncertainty.ask.why(AskWhy(None, int(text)), None))
        log = await self._editing.log(request.path_params["name"])
        return Document(explain_factor(why, graph) | {"inserted": log.inserted(int(text))})


def _told(number: float) -> float | None:
    """None of what nobody has looked at: JSON has no NaN."""
    return number if math.isfinite(number) else None
