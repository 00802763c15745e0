"""A connection to the bus, and the maps on it."""

import secrets
from collections.abc import Mapping, Sequence
from numbers import Integral
from os import PathLike
from typing import Any

from factorbus.client.arguments import checked_flag, checked_seconds, of_type
from factorbus.client.features import Features
from factorbus.client.link import Link, open_link
from factorbus.client.map import SUFFIX_LENGTH, Map
from factorbus.client.map_row import MapRow
from factorbus.client.pending_insert import raise_unseen
from factorbus.client.permission import inserts_pass
from factorbus.client.query_all import query_all
from factorbus.client.request_sender import Request, RequestSender
from factorbus.proto import codec, fields, keys
from factorbus.proto.budget import checked_budget
from factorbus.proto.camera import Camera
from factorbus.proto.fields import read_map
from factorbus.proto.interest import Interest, checked_interest
from factorbus.proto.keep import KEEP_ALL, keep_text
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.problems import BadOption, NotSupported, Problem, Refused, UnknownMap

_WINDOW = "a whole number, 1 or more"
_USUAL_S = 10.0
_LIST_S = 2.0  # to ask for the names of maps, where one was asked for that is not there


def connect(
    endpoint: str | Sequence[str],
    *,
    client: str = "client",
    timeout_s: float = _USUAL_S,
    settings: Mapping[str, Any] | None = None,
    zenoh: str | PathLike[str] = "",
    listening_s: float | None = None,
) -> "Bus":
    """Connect to a service or router, trying again until `timeout_s` has passed.

    endpoint: "tcp/127.0.0.1:7447", or several to choose from.  client: 1 to 55 of A-Z a-z 0-9 _ -; who we are in
    the service's lists.  timeout_s: also the default for everything done over this connection.
    zenoh: a zenoh configuration file, for certificates and passwords.  settings: more of the same, path to value.
    listening_s: give up after this, and not `timeout_s`, where nobody listens at all; None: wait for a service to come.
    Raises Unavailable, BadEndpoint, BadName, BadOption, BadSetting, BadConfigurationFile.
    """
    keys.checked_name("client", client, keys.LONGEST_NAME - SUFFIX_LENGTH)
    timeout_s = checked_seconds("timeout_s", timeout_s, _USUAL_S)
    listening_s = None if listening_s is None else checked_seconds("listening_s", listening_s, listening_s)
    endpoints = _endpoints(endpoint)
    of_type("zenoh", zenoh, (str, PathLike), "the path of a file")
    settings = of_type("settings", {} if settings is None else settings, Mapping, "a mapping of path to value")
    return Bus(open_link(endpoints, timeout_s, settings, str(zenoh), listening_s), client, timeout_s)


class Bus:
    """A connection to the bus; after a loss it comes back by itself.  Close it, or use it in `with`."""

    def __init__(self, link: Link, client: str, timeout_s: float) -> None:
        self.client, self.timeout_s = client, timeout_s
        self._link = link
        self._sender = RequestSender(link)
        self._maps: list[Map] = []
        self._features: list[Features] = []

    def __enter__(self) -> "Bus":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self.close(quietly=kind is not None)

    def map(
        self,
        name: str,
        mode: str = "auto",
        *,
        window: int = 32,
        mirror: bool = True,
        create: bool = True,
        client: str = "",
        interest: Interest | None = None,
        closures: str | None = None,
    ) -> Map:
        """Join map `name`, creating it if there is none (with create=False: UnknownMap).

        window: inserts that may be unanswered at a time.  mirror: keep a live copy of the estimate; returns once
        it is there.  client: who inserts into this map, where one connection is used for several; empty: that of
        `connect`.  interest: mirror these variables alone, at its rate; `insert` does not wait until they are there.
        closures: "trust", "test" or "robust", what becomes of its loop closures (None: as the service has it for new
        maps).  Its steps have the budget that the service has for new maps; `create` it first for another.
        Raises Refused, Unavailable, BadName, BadOption, UnknownKind, UnknownMap, NotSupported.
        """
        keys.checked_name("map", name)
        client = of_type("client", client, str, "a name, or an empty text for that of the connection") or self.client
        keys.checked_name("client", client, keys.LONGEST_NAME - SUFFIX_LENGTH)
        mirror, create = checked_flag("mirror", mirror), checked_flag("create", create)
        if isinstance(window, bool) or of_type("window", window, Integral, _WINDOW) < 1:
            raise BadOption("window", str(window), _WINDOW)
        part = None if interest is None else checked_interest(of_type("interest", interest, Interest, "an Interest"))
        if part is not None and not mirror:
            raise BadOption("interest", "given with mirror=False", "a mirror, which the interest is about")
        joined = Map(
            self._link,
            self._sender,
            client,
            self.timeout_s,
            window,
            lambda: self.create(name, mode, closures=closures) if create else self._existing(name),
        )
        self._maps = [*(each for each in self._maps if not each.closed), joined]
        try:
            joined.watch_owner()
            if mirror:
                joined.open_mirror(part)
        except BaseException:
            joined.close(quietly=True)
            raise
        return joined

    def features(
        self, camera: Camera, *, rho: float = 1.0, sigma_rho: float = 1.0, sigma_pixel: float = 1.0, service: str = ""
    ) -> Features:
        """Where a filter with `camera` has its inverse-depth features made; no map is involved.

        rho, sigma_rho: prior of every feature's inverse distance (1/metre).  sigma_pixel: standard deviation of u and
        of v (pixels).  service: its name; empty: whichever is there.
        """
        of_type("camera", camera, Camera, "a Camera")
        if of_type("service", service, str, "the name of a service, or an empty text for any"):
            keys.checked_name("service", service)
        made = Features(
            self._link,
            self._sender,
            self.timeout_s,
            camera,
            rho=rho,
            sigma_rho=sigma_rho,
            sigma_pixel=sigma_pixel,
            service=service,
        )
        self._features.append(made)
        return made

    def may_insert(self, name: str, *, timeout_s: float = 5.0) -> bool:
        """Whether access control lets this client insert into map `name`; False if the bus drops it for `timeout_s`.

        Nothing is inserted for it.  Raises Refused, Unavailable, BadName, UnknownMap.
        """
        row = self._existing(keys.checked_name("map", name))
        client = f"{self.client}-{secrets.token_hex(4)}"
        return inserts_pass(self._sender, name, client, row.epoch, checked_seconds("timeout_s", timeout_s, timeout_s))

    def maps(self, timeout_s: float | None = None) -> list[MapRow]:
        """The maps there are: of the service, or at a router of all services.  Raises Refused, Unavailable."""
        told = query_all(self._link, "maps", checked_seconds("timeout_s", timeout_s, self.timeout_s))
        return [row for each in told for row in _rows(each)]

    def stats(self, timeout_s: float | None = None) -> list[dict[str, Any]]:
        """What the service counts and times of itself and its maps; at a router a row for each service.

        Raises Refused, Unavailable.
        """
        told = query_all(self._link, "stats", checked_seconds("timeout_s", timeout_s, self.timeout_s))
        return [codec.decode_map(each) for each in told]

    def create(
        self,
        name: str,
        mode: str = "auto",
        *,
        timeout_s: float | None = None,
        closures: str | None = None,
        budget_ms: float | None = None,
        keep: str | Mapping[str, Any] | None = None,
    ) -> MapRow:
        """Create map `name`, or find it as it is if its mode is the same, and so are the others where they are given.

        closures: "trust", "test" or "robust", what becomes of its loop closures.  budget_ms: what a step of it may
        take, in milliseconds; what does not fit follows in later steps; 0: there is no bound.  keep: which poses stay
        of places that are driven through again and again, "all" or such as {"per_area": 2.0, "window": 50}.  None of
        any: that of a map which is there, or what the service has for new ones.
        Raises Refused, Unavailable, BadName, BadOption, NotSupported.
        """
        asked = {"map": keys.checked_name("map", name), "mode": mode, "closures": closures, "budget_ms": budget_ms}
        asked["keep"] = None if keep is None else keep_text(keep)
        given = {field: value for field, value in asked.items() if value is not None}
        row = self._admin("create", given, _row, timeout_s)
        if budget_ms and row.budget_ms != budget_ms:  # who knows of none skips the field
            raise NotSupported("a map whose steps have a budget", str(row.protocol.get("product", "")))
        if asked["keep"] not in (None, row.keep):
            raise NotSupported("a map that keeps some poses alone", str(row.protocol.get("product", "")))
        return row

    def set_budget(self, name: str, budget_ms: float | None, *, timeout_s: float | None = None) -> MapRow:
        """Give the steps of map `name` another budget, from the next one on: its row, once a restart would know it.

        budget_ms: what a step may take, in milliseconds, up to a minute; None or 0: there is no bound, and what earlier
        steps have left is done.  A replica and its upstream have a budget each: this changes one of them.
        Raises Refused (no_budget, journal_failed, ...), Unavailable, BadName, BadOption, UnknownMap.
        """
        asked = {"map": keys.checked_name("map", name), "budget_ms": checked_budget(budget_ms)}
        try:
            return self._admin("budget", asked, _row, timeout_s)
        except Refused as refused:
            raise self._named(name, refused) from None

    def fork(self, name: str, target: str, *, timeout_s: float | None = None) -> MapRow:
        """A new map `target` that begins as map `name` is now: a what-if, which may be tried out and dropped.

        Variables, values, factors, their ids, losses and what is fixed are the same, to the bit; the epoch is another,
        and neither map knows of the other afterwards.  Raises Refused (map_exists, ...), Unavailable, BadName,
        UnknownMap.
        """
        asked = {"map": keys.checked_name("map", name), "as": keys.checked_name("map", target)}
        try:
            return self._admin("fork", asked | {"request": secrets.randbits(62) | 1}, _row, timeout_s)
        except Refused as refused:
            raise self._named(name, refused) from None

    def drop(
        self,
        name: str,
        *,
        timeout_s: float | None = None,
        revision: int | None = None,
        missing_ok: bool = False,
        damaged: bool = False,
    ) -> None:
        """Drop map `name` and everything in it.  Raises Refused, Unavailable, BadName, UnknownMap.

        missing_ok: it is no error if there is no such map.

        revision: only if it is at this one and nothing is under way; else it stays, and Refused says `moved_on`.
        damaged: only if it is on disk and does not open: what is there is given up (`not_damaged`: it is open).
        """
        asked: dict[str, Any] = {"map": keys.checked_name("map", name)}
        asked |= {} if revision is None else {"revision": revision}
        asked |= {"damaged": True} if checked_flag("damaged", damaged) else {}
        missing_ok = checked_flag("missing_ok", missing_ok)
        try:
            self._admin("drop", asked, codec.decode_map, timeout_s)
        except Refused as refused:
            if not (missing_ok and refused.code == UnknownMap.code):
                raise self._named(name, refused) from None

    def close(self, *, quietly: bool = False) -> None:
        """Leave all maps and the bus.  What is unanswered fails with Unavailable.

        Unless quietly it raises as `Map.close`, of all maps together, when all is closed.
        """
        refused = [each for joined in self._maps for each in joined.close(quietly=True)]
        for front in self._features:
            front.close()
        self._sender.close()
        self._link.close()
        raise_unseen([] if quietly else refused)

    def _existing(self, name: str) -> MapRow:
        """As the map tells of itself: who may only ask a map need not be allowed to list all of them."""
        what = f"map {name!r}, asked for its stats,"
        asked = Request(what, keys.ask_key(name, "stats"), codec.encode_map({}), _row, self.timeout_s)
        try:
            return self._sender.carry(asked).future.result()
        except Refused as refused:
            raise self._named(name, refused) from None

    def _named(self, name: str, refused: Refused) -> Problem:
        """`refused`; of a map that is not there with the names of those that are, if this client may know them."""
        if refused.code != UnknownMap.code:
            return refused
        try:
            names = [row.name for row in self.maps(min(self.timeout_s, _LIST_S))]
            return UnknownMap(name, None if name in names else names)  # it may have come since
        except Problem:
            return UnknownMap(name)

    def _admin(self, operation: str, question: dict[str, Any], decode: Any, timeout_s: float | None) -> Any:
        timeout_s = checked_seconds("timeout_s", timeout_s, self.timeout_s)
        what = f"the service, asked for admin/{operation},"
        request = Request(what, keys.admin_key(operation), codec.encode_map(question), decode, timeout_s)
        return self._sender.carry(request).future.result()


def _endpoints(given: Any) -> list[str]:
    wanted = 'an address such as "tcp/127.0.0.1:7447", or several'
    listed = [given] if isinstance(given, str) else [*of_type("endpoint", given, Sequence, wanted)]
    if not listed:
        raise BadOption("endpoint", "an empty list", wanted)
    return [of_type("endpoint", each, str, wanted) for each in listed]


def _rows(data: bytes) -> list[MapRow]:
    content = read_map("maps", data, ANSWER_LIMITS)
    return [_row_of(f"maps[{i}]", row) for i, row in enumerate(fields.maps("", content, "maps"))]


def _row(data: bytes) -> MapRow:
    return _row_of("", read_map("map", data, ANSWER_LIMITS))


def _row_of(where: str, content: Mapping[str, Any]) -> MapRow:
    return MapRow(
        name=fields.text(where, content, "name"),
        mode=fields.text(where, content, "mode"),
        epoch=fields.integer(where, content, "epoch"),
        revision=fields.integer(where, content, "revision"),
        variables=fields.integer(where, content, "variables"),
        factors=fields.integer(where, content, "factors"),
        state=fields.text(where, content, "state", default="open"),
        problem=fields.text(where, content, "problem", default=""),
        protocol=fields.mapping(where, content, "protocol"),
        converged=fields.flag(where, content, "converged") if "converged" in content else None,
        converging=fields.flag(where, content, "converging"),
        reproducible=fields.flag(where, content, "reproducible") if "reproducible" in content else None,
        reason=fields.text(where, content, "reason", default=""),
        closures=fields.text(where, content, "closures", default="trust"),
        budget_ms=fields.number(where, content, "budget_ms") if "budget_ms" in content else 0.0,
        complete=fields.flag(where, content, "complete", True),
        keep=fields.text(where, content, "keep", default=KEEP_ALL),
    )
