"""What an operator may set: endpoints, which maps, limits.  From code, or from a TOML file of the same names."""

import re
import tomllib
import types
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from factorbus.ownership import UnsafeFolder, check_settings_file
from factorbus.proto.budget import BUDGET_SPAN_MS, BUDGET_WANTED
from factorbus.proto.closures import CLOSURE_POLICIES
from factorbus.proto.endpoints import checked_endpoint
from factorbus.proto.keep import KEEP_ALL, keep_text
from factorbus.proto.keys import checked_name
from factorbus.proto.limits import MessageLimits
from factorbus.proto.problems import Problem
from factorbus.wording.unreadable import is_device

_THIS_HOST = ("127.0.0.1", "localhost", "[::1]", "0.0.0.0", "[::]")
_HOST_PORT = re.compile(r"(?:\[[0-9a-fA-F:]+\]|[^\s:/]+):\d{1,5}")
# Limits for which 0 means: find it out.
_MAY_BE_0 = ("memory_bytes",)
DURABILITIES = ("none", "group", "commit")


class BadConfig(Problem):
    """A setting that does not exist or cannot have the value it was given."""

    code = "bad_config"


class UnsafeConfig(BadConfig):
    """Others could put settings of their own in the place of ours."""

    code = "unsafe_folder"

    def __init__(self, unsafe: UnsafeFolder) -> None:
        super().__init__(unsafe.message)
        self.detail |= unsafe.detail


@dataclass(frozen=True, slots=True)
class Limits:
    """What one service takes before it says no.  Every refusal names the limit that was met.

    Each is per map unless it says otherwise.
    """

    maps: int = 64  # in this service
    clients: int = 1024  # names whose place in their sequence is known ...
    client_idle_s: float = 600.0  # ... unless one has been silent for so long: it makes room for a new one
    waiting: int = 256  # inserts admitted and not yet in a step; as many again may be parked
    waiting_bytes: int = 256 << 20
    changes: int = 64  # inserts with changes of one client, admitted or parked, that have no answer yet
    questions: int = 256  # waiting for the solver to come to a revision
    interests: int = 64  # different ones that clients follow ...
    interest_lease_s: float = 30.0  # ... each until nobody has asked about it for so long
    remembered: int = 1024  # answers per client that a repeated sequence number gets again
    step_inserts: int = 64  # inserts that one step takes in ...
    step_bytes: int = 4 << 20  # ... as long as they have no more bytes than so together
    unwritten: int = 1024  # inserts that the journal has yet to write before the solver gets more
    parked_s: float = 5.0  # how long an insert waits for the one before it
    message_bytes: int = 64 << 20
    answer_bytes: int = 256 << 20  # of one answer, which clients must be able to receive
    insert_variables: int = 1_000_000
    insert_factors: int = 1_000_000
    variables: int = 20_000_000
    factors: int = 100_000_000
    snapshot_steps: int = 1000  # a snapshot after this number of steps ...
    snapshot_bytes: int = 64 << 20  # ... or of bytes of deltas
    jobs: int = 64  # batch optima being computed or waiting, in this service
    sessions: int = 1000  # connections to this service
    memory_bytes: int = 0  # of this process, before what would make maps grow is refused; 0: 4/5 of what there is

    def message(self) -> MessageLimits:
        """The codec's part of the limits."""
        return MessageLimits(self.message_bytes, self.insert_variables, self.insert_factors)


@dataclass(frozen=True, slots=True)
class Config:
    """How a service is on the bus.

    mode: "peer" is a hub of its own that clients connect to; "router" the same and other routers may join;
    "client" needs `connect` and meets its clients at a router.  maps: the names this service answers for, a name or
    a beginning and `*`; several services at one router need patterns that do not overlap.  create: maps there are
    from the start.  zenoh: path of a Zenoh configuration file for everything not said here (TLS, access control).
    insecure: listen beyond this machine even without these.
    """

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()
    mode: str = "peer"
    name: str = ""  # of this service, in its liveliness tokens; empty: made up
    maps: str = "*"
    create: tuple[str, ...] = ()
    closures: str = (
        "trust"  # of maps that are new here, unless the client that creates one says otherwise: trust or test
    )
    budget_ms: float = 0.0  # likewise: what a step of such a map may take; 0: it has no bound
    keep: str = KEEP_ALL  # likewise: which poses of places that are driven through again and again
    zenoh: str = ""
    insecure: bool = False
    warm: bool = True  # compile every kernel before taking the first insert
    job_deadline_s: float = 120.0  # for one worker to answer one job
    stuck_s: float = 120.0  # a thread that does not come to its next work for so long is stuck, the service not alive
    metrics: str = ""  # HOST:PORT where /metrics, /live and /ready are served over HTTP; empty: nowhere
    journal: str = ""  # folder where maps are kept; empty: they end with the service
    durability: str = "commit"  # what an answer promises of it: none, group or commit
    group_s: float = 0.05  # durability group: written no later than this after the answer
    checkpoint_s: float = 5.0  # of steps, after which the solver's state is written, so that a restart is quick
    cores: int = 2  # that one elimination may be at work on at once, of those that there are
    # From so much memory of a map on; before, each on its own thread alone.  10,000 poses in a plane, 2,000 in space.
    cores_from_bytes: int = 64 << 20
    upstream: str = ""  # endpoint of the service that has the same maps, which this one follows; empty: nobody
    upstream_zenoh: str = ""  # path of a Zenoh configuration file for the session with it (TLS, user)
    standby: bool = False  # wait until the process that owns the journal's folder is gone
    limits: Limits = field(default_factory=Limits)


def load_config(path: str | Path, **overrides: Any) -> Config:
    """The configuration in the TOML file `path`; `overrides` win.

    Raises BadConfig, UnsafeConfig, BadEndpoint, BadName, OSError.
    """
    if is_device(path):
        raise BadConfig(f"{path} is a device; wanted a file in TOML")
    if not overrides.get("insecure"):
        try:
            check_settings_file("the configuration", Path(path))
        except UnsafeFolder as unsafe:
            raise UnsafeConfig(unsafe) from None
    with Path(path).open("rb") as file:
        try:
            content = tomllib.load(file)
        except tomllib.TOMLDecodeError as error:
            raise BadConfig(f"{path} is not TOML: {error}") from None
    return checked_config(replace(_build(Config, content, str(path)), **overrides))


def checked_config(config: Config) -> Config:
    """`config`, if it can work.  Raises BadConfig, BadEndpoint, BadName."""
    for endpoint in (*config.listen, *config.connect, *([config.upstream] if config.upstream else ())):
        checked_endpoint(endpoint)
    for name in config.create:
        checked_name("map", name)
    if config.name:
        checked_name("service", config.name)
    if config.mode not in ("peer", "router", "client"):
        raise BadConfig(f"mode is {config.mode!r}; wanted peer, router or client")
    if config.mode == "client" and not config.connect:
        raise BadConfig(
            "mode is 'client' and there is nothing to connect to; give "
            '--connect ENDPOINT, in a file connect = ["tcp/HOST:7447"]'
        )
    if config.mode != "client" and not config.listen and not config.connect:
        raise BadConfig(
            "there is nothing to listen on or connect to; give "
            '--listen ENDPOINT, in a file listen = ["tcp/127.0.0.1:7447"]'
        )
    for name in (f.name for f in fields(Limits)):
        least = 0 if name in _MAY_BE_0 else 1e-9
        if getattr(config.limits, name) < least:
            raise BadConfig(f"limits.{name} is {getattr(config.limits, name)}; wanted more than 0")
    for name in ("job_deadline_s", "stuck_s", "group_s", "checkpoint_s"):
        if getattr(config, name) <= 0:
            raise BadConfig(f"{name} is {getattr(config, name)}; wanted more than 0")
    if config.cores < 1:
        raise BadConfig(f"cores is {config.cores}; wanted 1, for the map's own thread alone, or more")
    if config.cores_from_bytes < 0:
        raise BadConfig(f"cores_from_bytes is {config.cores_from_bytes}; wanted 0, for maps of any size, or more")
    if config.metrics and not _HOST_PORT.fullmatch(config.metrics):
        raise BadConfig(f"metrics is {config.metrics!r}; wanted HOST:PORT, such as 127.0.0.1:9464")
    if config.metrics and int(config.metrics.rpartition(":")[2]) > 65535:
        raise BadConfig(f"metrics is {config.metrics!r}; wanted a port from 0 to 65535")
    if config.closures not in CLOSURE_POLICIES:
        raise BadConfig(f"closures is {config.closures!r}; wanted {' or '.join(CLOSURE_POLICIES)}")
    if not BUDGET_SPAN_MS[0] <= config.budget_ms <= BUDGET_SPAN_MS[1]:
        raise BadConfig(f"budget_ms is {config.budget_ms:g}; wanted {BUDGET_WANTED}")
    try:
        keep_text(config.keep)
    except Problem as bad:
        raise BadConfig(bad.message) from None
    if config.durability not in DURABILITIES:
        raise BadConfig(f"durability is {config.durability!r}; wanted {', '.join(DURABILITIES)}")
    if config.standby and not config.journal:
        raise BadConfig(
            'standby without a journal: there is nothing to take over; give --journal DIR, in a file journal = "DIR"'
        )
    if config.upstream and not config.journal:
        raise BadConfig(
            "upstream without a journal: what upstream does not have yet is kept in it; "
            'give --journal DIR, in a file journal = "DIR"'
        )
    if (
        config.upstream
        and config.mode != "client"
        and _at_this_host(config.upstream) in map(_at_this_host, config.listen)
    ):
        raise BadConfig(
            f"upstream is {config.upstream}, where this service listens: that is itself; give another one's"
        )
    if config.upstream_zenoh and not config.upstream:
        raise BadConfig(
            'upstream_zenoh without an upstream; give --upstream ENDPOINT, in a file upstream = "tcp/HOST:7447"'
        )
    usual = Config()
    for name in ("durability", "group_s", "checkpoint_s"):
        if getattr(config, name) != getattr(usual, name) and not config.journal:
            raise needs_journal(name)
    stem = config.maps.removesuffix("*")
    if not config.maps or not all(c.isalnum() or c in "_-" for c in stem) or not stem.isascii():
        raise BadConfig(f"maps is {config.maps!r}; wanted a map name or the beginning of one and a *, such as site7-*")
    return config


def _at_this_host(endpoint: str) -> str:
    """`endpoint`, with one name for this host."""
    address = endpoint.partition("/")[2]
    host, _, port = address.rpartition(":")
    return port if host in _THIS_HOST else address


def needs_journal(name: str) -> BadConfig:
    """`name` is set, and there is no journal that it could be of."""
    return BadConfig(
        f'{name} without a journal: maps end with the service; give --journal DIR, in a file journal = "DIR"'
    )


def _build(kind: type, content: Mapping[str, Any], where: str) -> Any:
    """A `kind` from a table.  Strict: a misspelt setting must not be a setting ignored."""
    types_of = get_type_hints(kind)
    if unknown := sorted(set(content) - set(types_of)):
        raise BadConfig(f"{where}: {unknown[0]!r} is not a setting; wanted one of {', '.join(types_of)}")
    return kind(**{name: _value(types_of[name], value, f"{where}: {name}") for name, value in content.items()})


def _value(kind: Any, value: Any, where: str) -> Any:
    if kind is Limits:
        if not isinstance(value, dict):
            raise BadConfig(f"{where} is {value!r}; wanted a table")
        return _build(Limits, value, where)
    if get_origin(kind) is tuple:
        item = get_args(kind)[0]
        if not isinstance(value, list):
            raise BadConfig(f"{where} is {value!r}; wanted an array")
        return tuple(_value(item, entry, where) for entry in value)
    if kind is float and type(value) is int and abs(value) < _MOST_S:
        return float(value)
    if type(value) is not kind:
        raise BadConfig(f"{where} is {value!r}; wanted {_NAMES[kind]}")
    if kind is float and not abs(value) < _MOST_S:
        raise BadConfig(f"{where} is {value!r}; wanted a number below {_MOST_S:g}")
    return value


_MOST_S = 1e9  # what clocks and waiting threads can count
_NAMES = types.MappingProxyType({int: "a whole number", float: "a number", str: "a string", bool: "true or false"})
