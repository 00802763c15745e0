"""Who may do what, over TLS with certificates: for each role everything it must be able to do, and nothing else.

The matrix is whole: every identity tries every operation.  An operation works if its effect is seen, not if no error
came: what Zenoh denies it drops without a word.
"""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh
from bare import Bare, pose, start
from processes import Process, processes
from secured import NAMES, Secured
from zenoh.handlers import Callback

from factorbus.client import Draft, connect
from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Insert
from factorbus.proto.problems import Unavailable

P = keys.PREFIX
SETTLED_S = 0.4  # what is denied is seen by nothing happening: so long, while the same allowed takes milliseconds
ALLOWED_S = 60.0  # what is allowed is waited for until it has happened


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Secured:
    return Secured(tmp_path_factory.mktemp("secured"))


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Process]]:
    with processes(tmp_path_factory.mktemp("logs")) as start_one:
        yield start_one


@pytest.fixture(scope="module")
def hub(secured: Secured, started: Callable[..., Process], tmp_path_factory: pytest.TempPathFactory) -> str:
    """A service that listens with TLS, keeps two maps in a journal, and has a worker."""
    service = started(
        "-m", "factorbus.service", "--listen", "tls/127.0.0.1:0", "--zenoh", str(secured.server), "--name", "s1",
        "--create", "kitchen", "--create", "hall", "--journal", str(tmp_path_factory.mktemp("journal")),
    )  # fmt: skip
    endpoint = service.ready()[0]
    worker = started(
        "-m", "factorbus.workers", "--connect", endpoint, "--zenoh", str(secured.clients["w1"]), "--name", "w1-a"
    )
    worker.ready()
    return endpoint


class Identity:
    """One session, trying things."""

    def __init__(self, name: str, session: zenoh.Session, observer: zenoh.Session) -> None:
        self.name, self.session, self.observer = name, session, observer
        self.waits_s = SETTLED_S
        self._bare = Bare(session)

    def answered(self, key: str, payload: bytes = b"") -> bool:
        """Does anybody say anything to a query?"""
        return self._bare.ask(key if key.startswith("@") else f"{P}/{key}", payload) is not None

    def published(self, key: str) -> bool:
        """Does an operator see what is put there?"""
        return self._seen(
            lambda see: self.observer.declare_subscriber(f"{P}/{key}", see), lambda: self.session.put(f"{P}/{key}", "x")
        )

    def hears(self, key: str) -> bool:
        """Does it get the delta of a step in `key`'s map?"""
        name = key.split("/")[1]
        return self._seen(
            lambda see: self.session.declare_subscriber(f"{P}/{key}", see), lambda: poke(self.observer, name)
        )

    def sees(self, token: str) -> bool:
        """Does it learn that somebody is alive?"""
        return any(reply.ok is not None for reply in self.session.liveliness().get(f"{P}/{token}", timeout=ALLOWED_S))

    def seen(self, token: str) -> bool:
        """Does an operator learn that it declared `token`?"""
        return self._seen(
            # With history: the token may get there before the subscription does.
            lambda see: self.observer.liveliness().declare_subscriber(f"{P}/{token}", see, history=True),
            lambda: self.session.liveliness().declare_token(f"{P}/{token}"),
        )

    def answers(self, key: str) -> bool:
        """Does a query on `key` by an operator come to it?"""
        return self._seen(
            lambda see: self.session.declare_queryable(f"{P}/{key}", see),
            lambda: list(self.observer.get(f"{P}/{key}", timeout=0.3)),
        )

    def _seen(self, listen: Callable[[Any], Any], act: Callable[[], Any]) -> bool:
        came: list[object] = []
        with ExitStack() as stack:
            stack.callback(listen(Callback(lambda each: came.append(each), indirect=False)).undeclare)
            until, done = time.monotonic() + self.waits_s, None
            while not came and time.monotonic() < until:
                done = done or act()  # the first may go before the declaration has arrived
                done = act() if not hasattr(done, "undeclare") else done
                time.sleep(0.02)  # nothing tells when a declaration has arrived
            if hasattr(done, "undeclare"):
                done.undeclare()
        return bool(came)


def poke(session: zenoh.Session, name: str) -> None:
    """Have map `name` make a step: every client that may hear its delta does."""
    client = f"ops-{time.monotonic_ns()}"
    payload = codec.encode_insert(Insert(1, Batch(), settle=True))
    list(session.get(keys.insert_key(name, client), payload=payload, timeout=2.0))


INSERT = codec.encode_insert(Insert(1, Batch(), settle=True))
CREATE = codec.encode_map({"map": "kitchen"})
BUDGET = codec.encode_map({"map": "none", "budget_ms": 1.0})

# What is tried: a name, the trial, and who it must work for; for everybody else it must not.
TRIALS: dict[str, tuple[Callable[[Identity], bool], tuple[str, ...]]] = {
    **{
        f"insert into kitchen as {who}": (
            lambda me, who=who: me.answered(f"map/kitchen/in/{who}-{me.name}", INSERT),
            (who,) if who != "ops" else ("ops",),
        )
        for who in ("robot1", "robot2", "ops")
    },
    "insert into kitchen as wall": (lambda me: me.answered("map/kitchen/in/wall-1", INSERT), ()),
    "insert as robot12": (lambda me: me.answered("map/kitchen/in/robot12-1", INSERT), ()),
    "insert into hall as robot1": (lambda me: me.answered("map/hall/in/robot1-1", INSERT), ()),
    "insert into hall as robot2": (lambda me: me.answered("map/hall/in/robot2-1", INSERT), ("robot2",)),
    "insert as anybody": (lambda me: me.answered("map/kitchen/in/*", INSERT), ()),
    "insert as any robot1": (lambda me: me.answered("map/kitchen/in/robot1$*", INSERT), ()),
    **{
        f"ask kitchen for {question}": (
            lambda me, question=question: me.answered(f"map/kitchen/ask/{question}"),
            ("robot1", "robot2", "wall", "ops"),
        )
        for question in keys.QUESTIONS
    },
    **{
        f"ask hall for {question}": (
            lambda me, question=question: me.answered(f"map/hall/ask/{question}"),
            ("robot2", "ops", "boat") if question == "records" else ("robot2", "ops"),
        )
        for question in keys.QUESTIONS
    },
    **{
        f"send records of {name} as {who}": (
            lambda me, name=name, who=who: me.answered(f"map/{name}/records/{who}"),
            ("boat",) if (name, who) == ("hall", "boat") else (),
        )
        for name in ("kitchen", "hall")
        for who in ("boat", "robot2", "*")
    },
    "ask every map": (lambda me: me.answered("map/*/ask/stats"), ("ops",)),
    "ask everything": (lambda me: me.answered("**"), ()),
    "list maps": (lambda me: me.answered("admin/maps"), ("ops",)),
    "read the service's statistics": (lambda me: me.answered("admin/stats"), ("ops",)),
    "create a map": (lambda me: me.answered("admin/create", CREATE), ("ops", "boat")),
    "drop a map": (lambda me: me.answered("admin/drop", codec.encode_map({"map": "none"})), ("ops",)),
    "change a budget": (lambda me: me.answered("admin/budget", BUDGET), ("ops",)),
    "fork a map": (lambda me: me.answered("admin/fork", codec.encode_map({"map": "none", "as": "n"})), ("ops",)),
    "any operation": (lambda me: me.answered("admin/**"), ()),
    "have features made": (lambda me: me.answered("features/s1/ask"), ("robot1", "robot2")),
    "give a worker a job": (lambda me: me.answered("worker/w1-a/job"), ()),
    "read the bus's own records": (lambda me: me.answered("@/**"), ()),
    **{
        f"forge {channel} of kitchen": (lambda me, channel=channel: me.published(f"map/kitchen/out/{channel}"), ())
        for channel in ("delta", "snapshot", "event")
    },
    "put an insert": (lambda me: me.published("map/kitchen/in/robot1-1"), ()),
    "follow kitchen": (lambda me: me.hears("map/kitchen/out/delta"), ("robot1", "robot2", "wall", "ops")),
    "follow hall": (lambda me: me.hears("map/hall/out/delta"), ("robot2", "ops")),
    "follow all of hall": (lambda me: me.hears("map/hall/**"), ()),
    "see who keeps kitchen": (
        lambda me: me.sees("map/kitchen/live/service/*"), ("robot1", "robot2", "wall", "ops")
    ),
    "see who keeps hall": (lambda me: me.sees("map/hall/live/service/*"), ("robot2", "ops")),
    "see workers": (lambda me: me.sees("worker/*/live/*"), ("ops",)),
    "see who makes features": (lambda me: me.sees("features/*/live"), ("robot1", "robot2", "wall", "ops", "boat")),
    **{
        f"be seen in kitchen as {who}": (
            lambda me, who=who: me.seen(f"map/kitchen/live/client/{who}-{me.name}"), (who,)
        )
        for who in ("robot1", "robot2")
    },
    "pose as the owner of kitchen": (lambda me: me.seen("map/kitchen/live/service/s2"), ()),
    "answer for kitchen": (lambda me: me.answers("map/kitchen/ask/estimate"), ()),
    "take inserts for kitchen": (lambda me: me.answers("map/kitchen/in/ops-9"), ()),
    "answer admin": (lambda me: me.answers("admin/maps"), ()),
    "be seen as worker w1": (lambda me: me.seen(f"worker/w1-{me.name}/live/1"), ("w1",)),
    "be seen as worker w2": (lambda me: me.seen(f"worker/w2-{me.name}/live/1"), ()),
}  # fmt: skip


@pytest.fixture(scope="module")
def identities(secured: Secured, hub: str) -> Iterator[dict[str, Identity]]:
    with ExitStack() as stack:
        observer = stack.enter_context(secured.session("ops", hub))
        yield {name: Identity(name, stack.enter_context(secured.session(name, hub)), observer) for name in NAMES}


@pytest.mark.parametrize("trial", TRIALS)
@pytest.mark.parametrize("name", NAMES)
def test_the_matrix(identities: dict[str, Identity], name: str, trial: str) -> None:
    (attempt, allowed), me = TRIALS[trial], identities[name]
    me.waits_s = ALLOWED_S if name in allowed else SETTLED_S
    assert attempt(me) == (name in allowed)


def test_the_client_library_does_its_part_in_every_role(secured: Secured, hub: str) -> None:
    with (
        connect(hub, client="ops", zenoh=secured.clients["ops"]) as ops,
        connect(hub, client="robot1", zenoh=secured.clients["robot1"]) as bus,
        connect(hub, client="wall", zenoh=secured.clients["wall"]) as wall,
        bus.map("kitchen", create=False) as kitchen,
        wall.map("kitchen", create=False) as picture,
    ):
        accepted = kitchen.insert(Draft().se2("x0", (1, 2, 0.5), fixed=True))
        picture.estimate.wait_for(accepted.revision)
        assert picture.estimate["x0"].tolist() == [1, 2, 0.5]
        assert kitchen.chi2(batch=True).batch == 0.0
        seen = iter(lambda: [row["name"] for row in ops.stats()[0]["workers"]], None)
        assert next(names for names in seen if names) == ["w1-a"]
        assert {row.name for row in ops.maps()} == {"kitchen", "hall"}
    with connect(hub, client="robot2", zenoh=secured.clients["robot1"], timeout_s=1) as bus:
        with pytest.raises(Unavailable, match="nobody replies"):  # another's name under one's own certificate
            bus.map("kitchen", create=False, mirror=False).insert(Draft())
        with pytest.raises(Unavailable, match=r"may this client create maps\?.* create=False \(access control drops"):
            bus.map("kitchen")  # a front end does not create maps
        with pytest.raises(Unavailable, match=r"may this client do that, which is an operator's\? \(access control"):
            bus.drop("kitchen")
    with connect(hub, client="wall", zenoh=secured.clients["wall"], timeout_s=1) as bus:
        with pytest.raises(Unavailable, match="may this client insert"):
            bus.map("kitchen", create=False, mirror=False).insert(Draft())
        with pytest.raises(Unavailable, match=r"nobody replies: is it running, and may this client ask\?"):
            bus.maps()


def test_strangers_do_not_get_in(secured: Secured, hub: str, tmp_path: Path) -> None:
    other = Secured(tmp_path)  # another authority, the same names
    plain = hub.replace("tls/", "tcp/")
    ca = json.dumps({"root_ca_certificate": str(secured.folder / "ca.pem")})
    anonymous = tmp_path / "anonymous.json5"
    anonymous.write_text(f"{{transport: {{link: {{tls: {ca}}}}}}}")
    for endpoint, file in ((hub, other.clients["ops"]), (hub, anonymous), (hub, ""), (plain, "")):
        with (
            pytest.raises(Unavailable, match="certificate or a password"),
            connect(endpoint, zenoh=file, timeout_s=0.5),
        ):
            pass
    # Known to the authority, but nobody here: gets in, and can do nothing.
    stranger = tmp_path / "stranger.json5"
    content = secured.clients["robot1"].read_text().replace("robot1.", "stranger.")
    stranger.write_text(content)
    with connect(hub, zenoh=stranger, timeout_s=0.5) as bus, pytest.raises(Unavailable):
        bus.maps()


def test_nothing_of_what_was_tried_changed_the_map(identities: dict[str, Identity]) -> None:
    ops = Bare(identities["ops"].session)
    assert isinstance(ops.ask(keys.insert_key("hall", "ops-last"), codec.encode_insert(Insert(1, start("y0")))), bytes)
    assert isinstance(
        ops.ask(keys.insert_key("hall", "ops-last"), codec.encode_insert(Insert(2, pose("y1", "y0")))), bytes
    )
    estimate = codec.decode_estimate(ops.estimate("hall"))
    assert sum(len(group.keys) for group in estimate.variables) == 2


def test_a_replica_follows_over_tls_in_its_role(
    secured: Secured, hub: str, started: Callable[..., Process], tmp_path: Path
) -> None:
    upstream = ("--upstream", hub, "--upstream-zenoh", str(secured.clients["boat"]))
    journal = ("--journal", str(tmp_path / "journal"))
    replica = started(
        "-m",
        "factorbus.service",
        "--listen",
        "tcp/127.0.0.1:0",
        "--name",
        "boat",
        "--create",
        "hall",
        *journal,
        *upstream,
    )
    with (
        connect(replica.ready()[0], client="front", timeout_s=ALLOWED_S) as aboard,
        connect(hub, client="ops", zenoh=secured.clients["ops"], timeout_s=ALLOWED_S) as ops,
        aboard.map("hall", create=False) as driven,
        ops.map("hall", create=False) as followed,
    ):
        driven.insert(Draft().se2("b0", (1, 2, 0.5), fixed=True))
        end = time.monotonic() + ALLOWED_S
        while "b0" not in followed.estimate:
            assert time.monotonic() < end, replica.errors()
            time.sleep(0.05)  # a mirror notifies callbacks, not the test
