"""The gateway's web application: which address gives what, and how problems look over HTTP.

| address | |
|---|---|
| / | the page: the list of maps, and a map by `#name` |
| /api/maps | the maps of the service |
| /api/maps/NAME/estimate, /graph, /stats, /closures, /ellipses | JSON |
| /api/maps/NAME/variables/KEY | what holds x12 where it is |
| /api/maps/NAME/optimum | χ² beside the optimum from scratch, whether that converged, a notice where it is better |
| /api/maps/NAME/edges, /factors/17 | which factor is between which variables; what one measures, and how it fits |
| /api/maps/NAME/suspects | loop closures that the estimate does not have, of a map that tests them |
| /api/maps/NAME/session, /edits | who asks and whether they may edit; what was edited, and with POST an edit |
| /api/maps/NAME/export?format=g2o | text, also `pyfg`, `jrl`, `tum` and `kitti`, of several robots with `&robot=a` |
| /api/maps/NAME/live | WebSocket: the estimate, then what each step changed |
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from factorbus.client import Bus, Problem
from factorbus.client.questions import logged
from factorbus.gateway.documents import Document, estimate, groups
from factorbus.gateway.documents import problem as document_of
from factorbus.gateway.edit_routes import editing_routes
from factorbus.gateway.explain import explain
from factorbus.gateway.guard import Guard, is_ours
from factorbus.gateway.live import follow_map
from factorbus.gateway.maps import JoinedMaps
from factorbus.gateway.people import VIEWER, People, Person
from factorbus.proto.asking import AskWhy
from factorbus.proto.problems import UnknownQuestion
from factorbus.proto.symbols import format_symbol, parse_symbol
from factorbus.viz.closures import closures_of

_PAGE = Path(__file__).parent / "page"
_STATUS = {
    "unknown_map": 404, "unknown_variable": 404, "unknown_question": 400,
    "bad_name": 400, "bad_symbol": 400, "bad_option": 400, "bad_message": 400, "bad_shape": 400, "not_finite": 400,
    "bad_information": 400, "not_allowed": 403, "unknown_factor": 404,
    "unavailable": 503, "shutting_down": 503, "other_protocol": 502,
}  # fmt: skip
# What a browser is to do with the page: run no script but ours, ask nobody but us, and show it in no page of others,
# where clicks meant for that would edit a map.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src data:; frame-ancestors 'none'; base-uri 'none'",
    "X-Frame-Options": "DENY",
    "Cache-Control": "no-cache",
}
_OPTIMUM_S = 60.0
# Codes of a WebSocket that is closed, from the range that is the application's.
_FOREIGN, _PROBLEM = 4403, 4404
_MOST_REASON = 120  # bytes of it, of 123 that a WebSocket has room for


def make_app(bus: Bus, hosts: Sequence[str] = ("127.0.0.1", "localhost"), people: People | None = None) -> Starlette:
    """The application, over a connection that stays the caller's.  hosts: names by which it may be called.

    people: who may edit; None: nobody.
    """
    maps = JoinedMaps(bus)
    guard = Guard(people or People(Person("local", VIEWER, "this gateway is for looking only")))
    one = "/api/maps/{name}"
    answers: dict[str, Callable[[JoinedMaps, Request], Awaitable[Response]]] = {
        "/api/maps": _list,
        f"{one}/estimate": _estimate,
        f"{one}/graph": _graph,
        f"{one}/closures": _closures,
        f"{one}/ellipses": _ellipses,
        f"{one}/stats": _stats,
        f"{one}/optimum": _optimum,
        f"{one}/export": _export,
        f"{one}/variables/{{key}}": _variable,
    }
    app = Starlette(
        routes=[
            Route("/", lambda _: FileResponse(_PAGE / "index.html", headers=_HEADERS)),
            *(Route(path, partial(answer, maps)) for path, answer in answers.items()),
            *editing_routes(one, maps, guard),
            WebSocketRoute(f"{one}/live", partial(_live, maps)),
            Mount("/page", StaticFiles(directory=_PAGE)),
        ],
        # A page of somebody else's that calls us by a name of its own does not get an answer.
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts))],
        exception_handlers={Problem: _problem, HTTPException: _no_answer},
    )
    app.router.redirect_slashes = False  # an address that the table above does not have is not there
    return app


async def _list(maps: JoinedMaps, _: Request) -> Response:
    rows = await asyncio.to_thread(maps.bus.maps)
    return Document({"maps": [asdict(row) | {"epoch": str(row.epoch)} for row in rows]})


async def _estimate(maps: JoinedMaps, request: Request) -> Response:
    async with maps.using(request.path_params["name"]) as joined:
        return Document(estimate(joined.map.estimate.snapshot()))


async def _graph(maps: JoinedMaps, request: Request) -> Response:
    async with maps.using(request.path_params["name"]) as joined:
        graph = await maps.graph(joined)
    factors = [
        {
            "kind": group.kind,
            "keys": [[format_symbol(key) for key in row] for row in group.keys.tolist()],
            "measured": group.measured.tolist(),
            "information": group.information.tolist(),
        }
        for group in graph.batch.factors
    ]
    at = {"epoch": str(graph.epoch), "revision": graph.revision}
    return Document(at | {"variables": groups(graph.batch.variables), "factors": factors})


async def _closures(maps: JoinedMaps, request: Request) -> Response:
    async with maps.using(request.path_params["name"]) as joined:
        graph = await maps.graph(joined)
    found = await asyncio.to_thread(closures_of, graph.batch.variables, graph.batch.factors)
    keys = [[format_symbol(key) for key in pair] for pair in found.keys.tolist()]
    return Document({"revision": graph.revision, "keys": keys, "misfit": found.misfit.tolist()})


async def _ellipses(maps: JoinedMaps, request: Request) -> Response:
    """Covariances of places (m²): xx xy xz yy yz zz."""
    async with maps.using(request.path_params["name"]) as joined:
        revision, spread = await maps.spread(joined)
    keys = [format_symbol(key) for key in spread.keys.tolist()]
    upper = spread.covariances.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    return Document({"revision": revision, "keys": keys, "covariances": upper.tolist()})


async def _stats(maps: JoinedMaps, request: Request) -> Response:
    async with maps.using(request.path_params["name"]) as joined:
        stats = await asyncio.wrap_future(joined.map.ask.stats(None))
    return Document(stats | {"epoch": str(stats["epoch"])})


async def _optimum(maps: JoinedMaps, request: Request) -> Response:
    async with maps.using(request.path_params["name"]) as joined:
        found = await asyncio.wrap_future(joined.map.ask.chi2(True, _OPTIMUM_S))
    names = ("revision", "chi2", "batch", "start", "worker", "seconds", "batch_converged")
    told = {name: getattr(found, name) for name in names}
    notice = None if found.notice is None else {"code": found.notice.code, "message": found.notice.message}
    return Document(told | {"notice": notice})


async def _export(maps: JoinedMaps, request: Request) -> Response:
    async with maps.using(request.path_params["name"]) as joined:
        format, robot = request.query_params.get("format", "g2o"), request.query_params.get("robot")
        exported = await asyncio.wrap_future(joined.map.ask.export(format, None, robot))
    name = f"{request.path_params['name']}{f'-{robot}' if robot else ''}.{format}"
    text = logged(request.path_params["name"], exported)
    return PlainTextResponse(text, headers={"Content-Disposition": f'attachment; filename="{name}"'})


async def _variable(maps: JoinedMaps, request: Request) -> Response:
    key = parse_symbol(request.path_params["key"])
    async with maps.using(request.path_params["name"]) as joined:
        why = await asyncio.wrap_future(joined.map.uncertainty.ask.why(AskWhy(key), None))
    return Document(explain(why))


async def _live(maps: JoinedMaps, socket: WebSocket) -> None:
    """Only for pages of ours: a browser says where its page is from."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # the latter: it was closed before for what it sent
        await socket.accept()
        if not is_ours(socket.headers.get("origin"), socket.headers.get("host")):
            await socket.close(_FOREIGN, "this page is not from here")
            return
        try:
            async with maps.using(socket.path_params["name"]) as joined:
                await follow_map(socket, joined.map.estimate)
        except Problem as problem:
            reason = problem.message.encode()[:_MOST_REASON].decode(errors="ignore")
            await socket.close(_PROBLEM, reason)


async def _problem(_: Request, problem: Exception) -> Response:
    code, message = getattr(problem, "code", "internal"), getattr(problem, "message", str(problem))
    detail: Any = getattr(problem, "detail", {})
    return Document(document_of(code, message, detail), status_code=_STATUS.get(code, 409))


async def _no_answer(request: Request, fault: Exception) -> Response:
    """An address that there is not, or not for this method: below /api as a problem, like all others there."""
    http = fault if isinstance(fault, HTTPException) else HTTPException(500)
    status, headers = http.status_code, http.headers
    if not request.url.path.startswith("/api/"):
        return PlainTextResponse(http.detail, status, headers)
    wanted = "an address below /api/maps, as clients/README.md lists them, with GET, and POST for edits"
    problem = UnknownQuestion(f"{request.method} {request.url.path}", wanted)
    return Document(document_of(problem.code, problem.message, problem.detail), status_code=status, headers=headers)
