"""SIGTERM in the middle of a stream: what was accepted is solved, published and answered; nothing else is taken."""

import queue
import signal
from collections.abc import Callable

import zenoh
from bare import PATIENCE_S, bare, pose, start
from processes import Process
from zenoh.handlers import Callback

from factorbus.proto import codec, keys
from factorbus.proto.messages import Accepted, Delta, Insert
from factorbus.proto.problems import Refused

INSERTS = 200


def test_sigterm_in_the_middle_of_a_stream_loses_nothing(spawn: Callable[..., Process]) -> None:
    service = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--create", "m")
    with bare(service.ready()[0]) as client:
        deltas: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        events: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        follow(client.session, keys.delta_key("m"), deltas)
        follow(client.session, keys.event_key("m"), events)
        sent = [client.send(keys.insert_key("m", "robot"), insert(n)) for n in range(1, INSERTS // 2)]
        first = sent[0].get(timeout=PATIENCE_S)
        assert isinstance(first, bytes)
        service.signal(signal.SIGTERM)
        sent += [client.send(keys.insert_key("m", "robot"), insert(n)) for n in range(INSERTS // 2, INSERTS)]
        answers = [first, *(waiting.get(timeout=PATIENCE_S) for waiting in sent[1:])]
        assert service.wait() == 0
        told = [codec.decode_delta(delta) for delta in drained(deltas)]
        happened = [codec.decode_map(event)["event"] for event in drained(events)]
    accepted = [codec.decode_accepted(answer) for answer in answers if isinstance(answer, bytes)]
    others = answers[len(accepted) :]
    assert [a.sequence for a in accepted] == list(range(1, len(accepted) + 1)), "a beginning of what was sent"
    assert all(a is None or (isinstance(a, Refused) and a.code == "shutting_down") for a in others), (
        "and no other answer"
    )
    assert happened == ["stopping"]
    check_published(told, accepted)


def check_published(told: list[Delta], accepted: list[Accepted]) -> None:
    """The deltas go on from one another and hold exactly the accepted variables."""
    assert [(d.previous, d.revision) for d in told] == [(n, n + 1) for n in range(accepted[-1].revision)]
    published = {int(key) for delta in told for group in delta.variables for key in group.keys}
    assert len(published) == len(accepted)


def insert(n: int) -> bytes:
    batch = start() if n == 1 else pose(f"x{n - 1}", f"x{n - 2}")
    return codec.encode_insert(Insert(n, batch))


def follow(session: zenoh.Session, key: str, into: "queue.SimpleQueue[bytes]") -> None:
    session.declare_subscriber(key, Callback(lambda sample: into.put(sample.payload.to_bytes()), indirect=False))


def drained(came: "queue.SimpleQueue[bytes]") -> list[bytes]:
    return [came.get() for _ in range(came.qsize())]


def test_sigint_before_anything_came_and_a_port_that_is_taken(spawn: Callable[..., Process]) -> None:
    service = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm")
    (endpoint,) = service.ready()
    second = spawn("-m", "factorbus.service", "--listen", endpoint, "--no-warm")
    assert second.wait() == 2
    service.signal(signal.SIGINT)
    assert service.wait() == 0


def test_what_is_there_after_a_restart_is_a_new_epoch(spawn: Callable[..., Process]) -> None:
    service = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--create", "m")
    (endpoint,) = service.ready()
    with bare(endpoint) as client:
        epoch = codec.decode_estimate(client.estimate("m")).epoch
    service.signal(signal.SIGKILL)
    service.wait()
    spawn("-m", "factorbus.service", "--listen", endpoint, "--create", "m").ready()
    with bare(endpoint) as client:
        refused = client.ask(keys.insert_key("m", "robot"), codec.encode_insert(Insert(1, start(), epoch=epoch)))
        assert isinstance(refused, Refused)
        assert refused.code == "wrong_epoch"
        assert refused.detail["epoch"] == codec.decode_estimate(client.estimate("m")).epoch != epoch
