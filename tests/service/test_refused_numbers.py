"""Whatever is wrong with inserts, who follows §6 of the contract gets on.

Every refusal tells whether its number is used up, and no message is sent for ever.
"""

import random
from collections.abc import Callable, Iterator

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorbus.proto import codec
from factorbus.proto.limits import MessageLimits as MessageLimits
from factorbus.proto.messages import Accepted, Batch, Factors, Insert, Variables
from factorbus.proto.place import find_place
from factorbus.proto.problems import BadMessage, Problem
from factorbus.service.config import Limits
from factorbus.service.core.admission import Admission
from factorbus.service.core.events import Answer, Applied, Arrived, Effect, InsertBatch, Outcome, Refuse, Verdict
from factorbus.service.core.map_state import MapCore
from factorbus.service.solving.arrival import read_insert
from factorbus.solver.errors import DuplicateVariable

EPOCH = 7
KEYS = np.array([1, 2])
MESSAGE_LIMITS = MessageLimits(1 << 20, 100, 100)
BATCH = Batch(
    (Variables("se2", KEYS, np.zeros((2, 3))),),
    (Factors("between_se2", KEYS[None], np.zeros((1, 3)), np.eye(3)[np.triu_indices(3)][None]),),
)
# Kinds of broken messages that a reader stumbles over at different places.
BROKEN: dict[str, Callable[[dict], bytes]] = {
    "text that is no UTF-8": lambda m: msgpack.packb(m | {"note": b""})[:-2] + b"\xa2\xff\xfe",
    "a key that is no text": lambda m: msgpack.packb({5: 6} | m),
    "a key that is no text, behind": lambda m: msgpack.packb(m | {5: 6}),
    "a key that is an array": lambda m: _with(m, b"\x91\x01", b"\x01"),
    "nested without end": lambda m: _with(m, b"\xa1x", b"\x91" * 5000 + b"\xc0"),
    "a thousand groups": lambda m: msgpack.packb(m | {"variables": [{}] * 1000}),
    "257 elements": lambda m: msgpack.packb(m | {"x": [0] * 257}),
    "5,000 arrays": lambda m: msgpack.packb(m | {"x": [[[0] * 250] * 250] * 20, "y": bytes(70_000)}),
    "a million arrays": lambda m: msgpack.packb(m | {"x": [[[[]] * 200] * 200] * 25}),
    "an epoch that is none": lambda m: msgpack.packb(m | {"epoch": "seven"}),
    "an epoch of 2^63": lambda m: msgpack.packb(m | {"epoch": 2**63}),
    "cut off": lambda m: msgpack.packb(m | {"x": "yz"})[:-1],
    "too large": lambda m: msgpack.packb(m | {"x": bytes(2 << 20)}),
    "an array": lambda m: msgpack.packb([m]),
    "nothing": lambda m: b"",
    "a number that is text": lambda m: msgpack.packb(m | {"sequence": str(m["sequence"])}),
    "number 0": lambda m: msgpack.packb(m | {"sequence": 0}),
    "number 2^63": lambda m: msgpack.packb(m | {"sequence": 2**63}),
    "number −1": lambda m: msgpack.packb(m | {"sequence": -1}),
    "no number": lambda m: msgpack.packb({name: value for name, value in m.items() if name != "sequence"}),
    "a far number": lambda m: msgpack.packb(m | {"sequence": m["sequence"] + 999}),
    "the next number": lambda m: msgpack.packb(m | {"sequence": m["sequence"] + 1}),
    "another epoch": lambda m: msgpack.packb(m | {"epoch": EPOCH + 1}),
    "convert_below −1": lambda m: msgpack.packb(m | {"convert_below": -1.0}),
    "an unknown loss": lambda m: msgpack.packb(m | {"changes": [{"change": "loss", "factors": b"", "loss": "none"}]}),
}
# In these the number itself is wrong, or behind what cannot be passed over.
UNREAD = {"nested without end", "an array", "nothing", "a number that is text", "number 0",
          "number 2^63", "number −1", "no number"}  # fmt: skip


def _with(message: dict, key: bytes, value: bytes) -> bytes:
    """`message` with a field in front that is given in bytes."""
    packed = msgpack.packb(message)
    return bytes([packed[0] + 1]) + key + value + packed[1:]


class Service:
    """A map's core and a solver that takes everything; of one client."""

    def __init__(self) -> None:
        self.core = MapCore("m", "bayes-tree", EPOCH, Limits(), 0.0)
        self.now = 0.0
        self.taken: list[tuple[str, int]] = []
        self._refuse: Callable[[Arrived], bool] = lambda _: False

    def refuse_where(self, refuse: Callable[[Arrived], bool]) -> None:
        self._refuse = refuse

    def send(self, client: str, payload: bytes) -> list[Effect]:
        """What is answered, to whom it is answered at once or after the 5 s for which one is parked."""
        self.now += 0.01
        read = read_insert(payload, client, payload, MESSAGE_LIMITS, self.now)
        if isinstance(read, Refuse):
            return self.core.unread(client, read)
        return list(self._run(self.core.insert(read)))

    def wait(self) -> list[Effect]:
        self.now += 6.0
        return self.core.tick(self.now)

    def _run(self, effects: list[Effect]) -> Iterator[Effect]:
        for effect in effects:
            if not isinstance(effect, InsertBatch):
                yield effect
                continue
            outcomes = tuple(Outcome(insert, self._answer(insert)) for insert in effect.inserts)
            yield from self._run(self.core.give_verdict(Verdict(outcomes, 1, len(outcomes))))
            yield from self._run(self.core.applied(Applied(0, 0, 0.0, self.now)))

    def _answer(self, insert: Arrived) -> bytes | Exception:
        if isinstance(insert.content, Problem):
            return insert.content
        if self._refuse(insert):
            return DuplicateVariable(1)
        self.taken.append((insert.client, insert.sequence))
        return codec.encode_accepted(Accepted(insert.sequence, EPOCH, 1, 0, 1))


class Client:
    """§6 as it stands: messages, broken or whole, numbered and sent until each has its final answer."""

    def __init__(self, service: Service, window: int) -> None:
        self._service, self._window = service, window
        self._names = (f"c{n}" for n in range(1000))
        self._begin()
        self.sendings = 0
        self.accepted: list[int] = []
        self.refused: list[int] = []

    def _begin(self) -> None:
        self._name, self._next, self._back_to = next(self._names), 1, 0
        self._flying: dict[int, tuple[int, bytes]] = {}
        self._again: list[int] = []

    def deliver(self, messages: list[Callable[[dict], bytes]]) -> None:
        waiting = list(enumerate(messages))
        while waiting or self._flying:
            while waiting and len(self._flying) < self._window and not self._back_to:
                which, make = waiting.pop(0)
                payload = make({"sequence": self._next, "epoch": EPOCH, **_content(which)})
                self._flying[self._next] = which, payload
                self._next += 1
                self._send(payload)
            if self._flying:
                self._settle(self._service.wait())
                again, self._again = self._again, []
                for number in again:
                    if number in self._flying:
                        self._send(self._flying[number][1])
            if self._back_to and not self._flying:
                self._next, self._back_to = self._back_to, 0
            assert self.sendings <= 4 * len(messages), "it goes round in circles"

    def _send(self, payload: bytes) -> None:
        self.sendings += 1
        self._settle(self._service.send(self._name, payload))

    def _settle(self, effects: list[Effect]) -> None:
        for effect in effects:
            asker = effect.asker  # type: ignore[union-attr]
            found = [(number, which) for number, (which, payload) in self._flying.items() if payload == asker]
            if not found:
                continue
            number, which = found[0]
            if isinstance(effect, Answer):
                del self._flying[number]
                self.accepted.append(which)
                continue
            assert isinstance(effect, Refuse)
            problem = codec.decode_problem(codec.encode_problem(effect.problem, effect.following))
            self._refusal(number, which, problem.code, problem.detail["next"])

    def _refusal(self, number: int, which: int, code: str, following: int) -> None:
        if code == "bad_sequence" and following < number and following in self._flying:
            self._again.append(number)
            return
        del self._flying[number]
        self.refused.append(which)
        if code in ("wrong_epoch", "unknown_map") or (code == "bad_sequence" and following > number):
            self.refused += [which for which, _ in self._flying.values()]
            self._begin()
        elif following <= number:
            self._back_to = min(following, self._back_to or following)


def _content(which: int) -> dict:
    content = msgpack.unpackb(codec.encode_insert(Insert(1, BATCH)))
    return {name: content[name] for name in ("variables", "factors")} | {"x": which}


def whole(message: dict) -> bytes:
    return msgpack.packb(message)


@pytest.mark.parametrize("kind", BROKEN)
def test_a_refusal_tells_whether_its_number_is_used_up(kind: str) -> None:
    service = Service()
    for sequence in (1, 2):
        assert isinstance(service.send("a", whole({"sequence": sequence, "epoch": EPOCH}))[0], Answer)
    effects = service.send("a", BROKEN[kind]({"sequence": 3, "epoch": EPOCH, **_content(0)})) or service.wait()
    (refused,) = [effect for effect in effects if isinstance(effect, Refuse)]
    problem = codec.decode_problem(codec.encode_problem(refused.problem, refused.following))
    wanted = service.core.stats(0.0)["clients"]["a"]
    not_taken = UNREAD | {"a far number", "the next number", "another epoch"}
    assert problem.detail["next"] == wanted == (3 if kind in not_taken else 4)
    (answer,) = service.send("a", whole({"sequence": wanted, "epoch": EPOCH}))
    assert isinstance(answer, Answer)
    assert answer.message


@pytest.mark.parametrize("window", [1, 4])
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_who_follows_the_contract_delivers_everything_that_is_whole(window: int, seed: int) -> None:
    """Each whole message is accepted, or refused once because one of the same window broke its place."""
    rng = random.Random(seed)
    kinds = list(BROKEN.values())
    messages = [rng.choice(kinds) if rng.random() < 0.4 else whole for _ in range(12)]
    service = Service()
    service.refuse_where(lambda insert: rng.random() < 0.2)
    client = Client(service, window)
    client.deliver(messages)
    assert sorted({*client.accepted, *client.refused}) == list(range(len(messages)))
    assert len(client.accepted) == len(set(client.accepted)), "accepted once"
    assert len(service.taken) == len(set(service.taken))


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), data=st.data())
def test_bytes_broken_anywhere_keep_nobody_up(seed: int, data: st.DataObject) -> None:
    """Cut, flipped, or with bytes put in, at any place of the message."""
    rng = random.Random(seed)

    def broken(message: dict) -> bytes:
        raw = bytearray(msgpack.packb(message))
        at = rng.randrange(len(raw))
        how = rng.choice(("cut", "flip", "insert"))
        if how == "cut":
            return bytes(raw[:at])
        if how == "flip":
            raw[at] ^= 1 << rng.randrange(8)
            return bytes(raw)
        return bytes(raw[:at]) + rng.randbytes(rng.randrange(1, 9)) + bytes(raw[at:])

    client = Client(Service(), data.draw(st.sampled_from([1, 3])))
    client.deliver([broken if rng.random() < 0.5 else whole for _ in range(10)])
    assert {*client.accepted, *client.refused} == set(range(10))


def test_a_repeated_refusal_is_the_first_one_to_the_byte() -> None:
    service = Service()
    broken = BROKEN["a thousand groups"]({"sequence": 1, "epoch": EPOCH})
    said = []
    for _ in range(2):
        (refused,) = service.send("a", broken)
        assert isinstance(refused, Refuse)
        said.append(codec.encode_problem(refused.problem, refused.following))
        service.send("a", whole({"sequence": 2, "epoch": EPOCH}))
    assert said[0] == said[1]


def test_a_client_that_finds_no_room_is_told_that_nothing_is_used_up() -> None:
    admission = Admission(EPOCH, Limits(clients=1))
    for name, wanted in (("a", []), ("b", [("too_large", 1)])):
        came = admission.admit(Arrived([name], name, 1, EPOCH, 10, 0, BadMessage("x", "y", "z"), 0.0))
        assert [(e.problem.code, e.following) for e in came if isinstance(e, Refuse)] == wanted


@pytest.mark.parametrize("sequence", [1, 127, 128, 65_535, 2**32, 2**63 - 1])
def test_the_place_of_a_message_is_found_behind_what_cannot_be_read(sequence: int) -> None:
    message = msgpack.packb({"x": b"", "sequence": sequence, "epoch": 5, "y": 1})
    assert find_place(message) == (sequence, 5)
    assert find_place(message[:-3]) == (sequence, 5)
    assert find_place(b"\x85\xa1z\xa1\xff" + message[1:]) == (sequence, 5)
    assert find_place(msgpack.packb({"sequence": float(sequence)})) is None
