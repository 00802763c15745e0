"""Who may do what on the bus, as Zenoh's access control: from a list of names by role to rules, subjects and policies.

    role         may
    front end    insert under its own name into its maps, ask and follow them, be seen; have features made
    viewer       ask and follow its maps
    worker       take jobs under its own name
    operator     all that a viewer may, the set of maps (list, create, fork, drop, stats), and insert under its own name
    replica      follow its maps as a service that has the same, create them, and send their records under its own name
    service      keep its maps: needed where services meet clients at a router
    router       everything: another router of the same fabric

Everything else is denied, silently: Zenoh drops what it denies, and a query ends without a reply.

"Under its own name": the client library appends a suffix that is new with every run, so robot1 may use the keys of
`robot1` and of `robot1-…`.  That is why a name here has no `-` in it: robot1-b would be a robot1.

A name is the common name of a TLS certificate, or a user's; Zenoh has no rule in terms of "the one that asks", so each
name gets rules of its own.  Flows are as the enforcing side sees them: ingress is from the one who is named.
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from factorbus.proto.keys import ANY_SERVICE_OF_ANY_VERSION, PREFIX
from factorbus.service.config import BadConfig

ROLES = ("front_end", "viewer", "worker", "operator", "replica", "service", "router")
_WITHOUT_MAPS = ("worker", "router")
_NAME = re.compile(r"[A-Za-z0-9_]{1,55}")
_PATTERN = re.compile(r"\*|[A-Za-z0-9_-]{1,64}|[A-Za-z0-9_-]{1,63}\*")
_ASK = ("query",)
_ANSWER = ("reply", "declare_queryable")
_SEE = ("liveliness_query", "declare_liveliness_subscriber")
_BE_SEEN = ("liveliness_token",)
_ALL = (
    "put", "delete", "declare_subscriber", "query", "declare_queryable", "reply",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Grant:
    """`name` has `role`.  maps: names of maps, or beginnings and `*`; of roles that have to do with maps."""

    name: str
    role: str
    maps: tuple[str, ...] = ("*",)


class AccessRule(NamedTuple):
    """What may pass in one direction: messages on keys, from (`ingress`) or to (`egress`) the one who is named."""

    flow: str
    messages: tuple[str, ...]
    keys: tuple[str, ...]


def read_grants(text: str, where: str = "access.toml") -> list[Grant]:
    """The grants in a TOML document: a table for each role, `name = ["map", "beginning-*"]`.  Raises BadConfig."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadConfig(f"{where} is not TOML: {error}") from None
    grants = []
    for role, names in content.items():
        if role not in ROLES:
            raise BadConfig(f"{where}: {role!r} is no role; wanted one of {', '.join(ROLES)}")
        if not isinstance(names, dict):
            raise BadConfig(f'{where}: {role} is {names!r:.40}; wanted a table, such as [{role}] and name = ["*"]')
        grants += [_grant(name, role, maps, where) for name, maps in names.items()]
    _check_names(grants, where)
    return grants


def access_control(grants: list[Grant], identify_by: str = "cert_common_names") -> dict[str, Any]:
    """Zenoh's `access_control` for `grants`.  identify_by: "cert_common_names", or "usernames"."""
    rules, policies = [], []
    for grant in grants:
        own = [
            {
                "id": f"{grant.name} {number}",
                "permission": "allow",
                "flows": [rule.flow],
                "messages": list(rule.messages),
                "key_exprs": list(rule.keys),
            }
            for number, rule in enumerate(rules_of(grant))
        ]
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [grant.name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": grant.name, identify_by: [grant.name]} for grant in grants],
        "policies": policies,
    }


def rules_of(grant: Grant) -> list[AccessRule]:
    """All that `grant` lets pass."""
    return list(_RULES[grant.role](grant))


def _grant(name: str, role: str, maps: Any, where: str) -> Grant:
    if not _NAME.fullmatch(name):
        raise BadConfig(f"{where}: {name!r} will not do as a name; wanted 1 to 55 letters, digits and _ (and no -)")
    if not isinstance(maps, list) or not all(isinstance(each, str) and _PATTERN.fullmatch(each) for each in maps):
        raise BadConfig(f'{where}: {role}.{name} is {maps!r:.60}; wanted maps, such as ["kitchen", "site7-*"]')
    if bool(maps) == (role in _WITHOUT_MAPS):
        wanted = "[]: it has to do with no map" if role in _WITHOUT_MAPS else 'at least one map, ["*"] for all'
        raise BadConfig(f"{where}: {role}.{name} is {maps!r:.60}; wanted {wanted}")
    return Grant(name, role, tuple(maps))


def _check_names(grants: list[Grant], where: str) -> None:
    seen: dict[str, str] = {}
    for grant in grants:
        if grant.name in seen:
            raise BadConfig(f"{where}: {grant.name} is {seen[grant.name]} and {grant.role}; wanted one role for a name")
        seen[grant.name] = grant.role


def _front_end(grant: Grant) -> Iterator[AccessRule]:
    yield from _inserts(grant)
    yield from _follows(grant)
    yield from _exchange(f"{PREFIX}/features/*/ask")
    yield from _sees(f"{PREFIX}/features/*/live", ANY_SERVICE_OF_ANY_VERSION)


def _viewer(grant: Grant) -> Iterator[AccessRule]:
    yield from _follows(grant)
    yield from _sees(ANY_SERVICE_OF_ANY_VERSION)


def _operator(grant: Grant) -> Iterator[AccessRule]:
    yield from _exchange(f"{PREFIX}/admin/*")
    yield from _inserts(grant)
    yield from _follows(grant)
    yield from _sees(f"{PREFIX}/features/*/live", f"{PREFIX}/worker/*/live/*", ANY_SERVICE_OF_ANY_VERSION)


def _worker(grant: Grant) -> Iterator[AccessRule]:
    jobs, alive = _own(f"{PREFIX}/worker/", grant.name, "/job"), _own(f"{PREFIX}/worker/", grant.name, "/live/*")
    yield AccessRule("ingress", _ANSWER, jobs)
    yield AccessRule("egress", _ASK, jobs)
    yield AccessRule("ingress", _BE_SEEN, alive)


def _replica(grant: Grant) -> Iterator[AccessRule]:
    sent = (key for each in _of_maps(grant, "records/") for key in _own(each, grant.name, ""))
    yield from _exchange(*_of_maps(grant, "ask/records"), *sent, f"{PREFIX}/admin/create")
    yield from _sees(f"{PREFIX}/features/*/live")


def _service(grant: Grant) -> Iterator[AccessRule]:
    maps = (key for below in ("in/*", "ask/*", "records/*") for key in _of_maps(grant, below))
    answered = (*maps, f"{PREFIX}/admin/*", f"{PREFIX}/features/*/ask")
    alive = (*_of_maps(grant, "live/service/*"), f"{PREFIX}/features/*/live")
    yield AccessRule("ingress", _ANSWER, answered)
    yield AccessRule("egress", _ASK, answered)
    yield AccessRule("ingress", ("put",), _of_maps(grant, "out/*"))
    yield AccessRule("egress", ("declare_subscriber",), _of_maps(grant, "out/*"))
    yield AccessRule("ingress", _BE_SEEN, alive)
    yield AccessRule("egress", _SEE, alive)
    # Is somebody else keeping its maps?  And who works?
    yield from _sees(*_of_maps(grant, "live/service/*"), f"{PREFIX}/worker/*/live/*")
    yield from _exchange(f"{PREFIX}/worker/*/job")


def _router(_grant: Grant) -> Iterator[AccessRule]:
    yield AccessRule("ingress", _ALL, ("**",))
    yield AccessRule("egress", _ALL, ("**",))


def _inserts(grant: Grant) -> Iterator[AccessRule]:
    yield from _exchange(*(key for each in _of_maps(grant, "in/") for key in _own(each, grant.name, "")))
    yield AccessRule(
        "ingress", _BE_SEEN, tuple(k for each in _of_maps(grant, "live/client/") for k in _own(each, grant.name, ""))
    )


def _follows(grant: Grant) -> Iterator[AccessRule]:
    yield from _exchange(*_of_maps(grant, "ask/*"))
    yield AccessRule("ingress", ("declare_subscriber",), _of_maps(grant, "out/*"))
    yield AccessRule("egress", ("put",), _of_maps(grant, "out/*"))
    yield from _sees(*_of_maps(grant, "live/service/*"), *_of_maps(grant, "live/client/*"))


def _exchange(*keys: str) -> Iterator[AccessRule]:
    """Queries, and what comes back."""
    yield AccessRule("ingress", _ASK, keys)
    yield AccessRule("egress", _ANSWER, keys)


def _sees(*keys: str) -> Iterator[AccessRule]:
    """Liveliness tokens of others."""
    yield AccessRule("ingress", _SEE, keys)
    yield AccessRule("egress", _BE_SEEN, keys)


def _of_maps(grant: Grant, below: str) -> tuple[str, ...]:
    return tuple(f"{PREFIX}/map/{_chunk(pattern)}/{below}" for pattern in grant.maps)


def _chunk(pattern: str) -> str:
    return pattern if pattern == "*" else pattern.replace("*", "$*")


def _own(before: str, name: str, behind: str) -> tuple[str, str]:
    """The keys of `name`, and of its runs."""
    return f"{before}{name}{behind}", f"{before}{name}-$*{behind}"


_RULES: Mapping[str, Callable[[Grant], Iterator[AccessRule]]] = {
    "front_end": _front_end,
    "viewer": _viewer,
    "worker": _worker,
    "operator": _operator,
    "replica": _replica,
    "service": _service,
    "router": _router,
}
