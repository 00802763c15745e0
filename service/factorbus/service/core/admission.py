"""Who may insert what next: sequence numbers per client, a bounded inbox, and a fair order between clients.

The rules, in the order they are tried (n is the number that the client has to send next, 1 at first):

    another epoch                       wrong_epoch, the number is not used up
    waiting, same bytes                 one more to answer when its answer is there
    answered, same bytes                the first answer again
    used for other bytes, or forgotten  bad_sequence
    the map is closing                  shutting_down, not used up
    the journal cannot be written       journal_failed, not used up
    n                                   admitted if the inbox has room, else busy, not used up
    after n, within the window          parked until the gap is closed; no room: busy; gap not closed: bad_sequence
    further                             bad_sequence

Every refusal tells what goes on from it (`Refuse.following`): a number above the insert's where that is used up, and n,
which is not above it, where it is not.

Parked inserts have room of their own: were they to fill the inbox, the one that closes the gap would find it full.

Nobody stands in another's way by sending much.  Who has nothing waiting finds room for one insert (not a huge one) in a
full inbox, too.  The order is that of a fair queue (start-time fair queueing, Goyal and others, 1996): each client's
inserts are laid end to end by their sizes on a time line of its own, which begins where the others are; the insert that
begins first goes first.  So a small one overtakes large ones of others, and equal ones take turns.

An insert that changes what the map has is a step by itself, so it goes to the solver by itself: what comes meanwhile
waits for no other.  On the time line it is as long as all the small inserts that one step takes in, and of one client
only a number of them may be without an answer: more are refused as busy, not used up.
"""

from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from itertools import count

from factorbus.proto.problems import BadSequence, Busy, Problem, ShuttingDown, TooLarge, WrongEpoch
from factorbus.service.config import Limits
from factorbus.service.core.events import Answer, Arrived, Asker, Effect, Refuse

# How many may wait for one and the same answer.
_ASKERS = 8
_RETRY_S = (0.02, 2.0)
# What an insert counts for besides its bytes: a step has its price, however small.
_INSERT_COST = 1024
_CHANGE_COST = 64 * _INSERT_COST
_CHANGES_WAIT = "changes of this client are under way, and no more may be"
# One sender (all clients of one name before its suffix) has at most this share of the names that are remembered.
_NAMES_OF_ONE = 4
_NAME_IDLE_S = 10.0
_LEAVE = "go on under one name instead of new ones, or raise the limit"


@dataclass(slots=True)
class _Client:
    """One client's place in its sequence."""

    next: int = 1
    served: float = 0.0  # where its inserts on the time line of fairness end
    heard: float = 0.0  # when it last sent what it has to send next
    seen: float = 0.0  # when it last sent anything
    ready: deque[Arrived] = field(default_factory=deque)
    open: dict[int, Arrived] = field(default_factory=dict)  # admitted or parked, not answered
    parked: dict[int, Arrived] = field(default_factory=dict)
    answered: OrderedDict[int, tuple[int, object]] = field(default_factory=OrderedDict)


class Admission:
    """The inserts of one map between their arrival and their answer."""

    def __init__(self, epoch: int, limits: Limits) -> None:
        self._epoch, self._limits = epoch, limits
        self._clients: dict[str, _Client] = {}
        self._turns: list[tuple[float, int, str]] = []  # heap of (begin, order, client with something ready)
        self._clock, self._order = 0.0, count()
        self._ready = self._parked = self._bytes = 0
        self._pace_s = 0.01  # seconds per insert, smoothed
        self._closing: Problem | None = None
        self._blocked: Problem | None = None

    @property
    def ready(self) -> int:
        """Inserts that wait for a step."""
        return self._ready

    @property
    def parked(self) -> int:
        """Inserts that wait for the one before them."""
        return self._parked

    @property
    def next_sequences(self) -> dict[str, int]:
        """What each client has to send next."""
        return {name: client.next for name, client in self._clients.items()}

    def admit(self, arrived: Arrived) -> list[Effect]:
        """Judge one arrival: nothing to say yet (it waits), or its answer."""
        try:
            return self._judge(arrived)
        except Problem as problem:
            return [Refuse(arrived.askers[0], problem, self.wanted(arrived.client))]

    def wanted(self, name: str) -> int:
        """The number that client `name` has to send next; 1 of one that is not known."""
        client = self._clients.get(name)
        return client.next if client is not None else 1

    def check_numbers(self, inserts: Iterable[tuple[str, int]]) -> None:
        """Raises BadSequence where one of (client, number) is used up."""
        for client, sequence in inserts:
            if sequence < (wanted := self.wanted(client)):
                raise BadSequence(client, sequence, f"{wanted} or more of that client", wanted)

    def take_alone(self, arrived: Arrived) -> bool:
        """Take the insert, if it is next, and nothing else waits here or is parked; if not, `admit` it."""
        client = self._clients.get(arrived.client)
        if (
            client is None
            or arrived.sequence != client.next
            or arrived.epoch not in (0, self._epoch)
            or self._ready
            or self._parked
            or self._closing is not None
            or self._blocked is not None
        ):
            return False
        client.seen = client.heard = arrived.now
        client.open[arrived.sequence] = arrived
        client.next += 1
        self._bytes += arrived.size
        self._clock = begin = max(self._clock, client.served)
        client.served = begin + arrived.size + _INSERT_COST
        return True

    def take(self, most: int) -> tuple[Arrived, ...]:
        """Up to `most` inserts for the next step, and no more than a step's bytes: who had least goes first.

        A change comes alone.
        """
        taken: list[Arrived] = []
        room = self._limits.step_bytes
        while self._turns and len(taken) < most:
            begin, _, name = self._turns[0]
            client = self._clients[name]
            insert = client.ready[0]
            if taken and (insert.size > room or insert.is_change or taken[0].is_change):
                break
            heappop(self._turns)
            room -= insert.size
            taken.append(client.ready.popleft())
            self._clock = begin
            client.served = begin + insert.size + (_CHANGE_COST if insert.is_change else _INSERT_COST)
            if client.ready:
                heappush(self._turns, (client.served, next(self._order), name))
        self._ready -= len(taken)
        return tuple(taken)

    def answer(self, insert: Arrived, answer: object, answered: Asker = None) -> list[Effect]:
        """`insert` has its answer: give it to all who wait for it, but who is `answered` already, and remember it."""
        client = self._clients[insert.client]
        del client.open[insert.sequence]
        self._bytes -= insert.size
        client.answered[insert.sequence] = (insert.digest, answer)
        if len(client.answered) > self._limits.remembered:
            client.answered.popitem(last=False)
        if answered is not None and len(insert.askers) == 1:
            return []
        return [_reply(asker, answer, insert.sequence) for asker in insert.askers if asker is not answered]

    def is_open(self, insert: Arrived) -> bool:
        """Has `insert` no answer yet?"""
        return self._clients[insert.client].open.get(insert.sequence) is insert

    def expire(self, now: float) -> list[Effect]:
        """Refuse what was parked for too long: its client has not sent what comes before."""
        if not self._parked:
            return []
        late = [c for c in self._clients.values() if c.parked and now - c.heard > self._limits.parked_s]
        return [effect for client in late for effect in self._unpark(client, None)]

    def close(self, problem: Problem | None = None) -> list[Effect]:
        """Take nothing new and refuse what is parked; with a `problem`, refuse what is ready as well."""
        self._closing = problem or ShuttingDown()
        effects = [e for c in self._clients.values() for e in self._unpark(c, self._closing)]
        if problem is not None:
            while self._ready:
                for insert in self.take(self._ready):
                    effects += self.answer(insert, problem)
        return effects

    def take_back(self, problem: Problem, given: bool) -> list[Effect]:
        """What waits did not happen: refuse it, its numbers not used up; `given`: what the solver has, too."""
        effects: list[Effect] = []
        for client in self._clients.values():
            gone = list(client.open.values()) if given else [*client.ready, *client.parked.values()]
            client.next = min([*(insert.sequence for insert in gone), client.next])
            for insert in gone:
                effects += [Refuse(asker, problem, client.next) for asker in insert.askers]
                del client.open[insert.sequence]
                self._bytes -= insert.size
            client.ready.clear()
            client.parked.clear()
        self._turns.clear()
        self._ready = self._parked = 0
        return effects

    def block(self, problem: Problem | None) -> None:
        """Refuse everything new with `problem`, its numbers not used up, until this is called with None."""
        self._blocked = problem

    @property
    def blocked(self) -> bool:
        """Is everything new refused?"""
        return self._blocked is not None

    def restore(self, name: str, following: int, answered: Iterable[tuple[int, int, object]], now: float) -> None:
        """`name` was here before: it has to send `following` next, and has had answers, (sequence, digest, answer)."""
        client = _Client(following, heard=now, seen=now)
        client.answered.update((sequence, (digest, answer)) for sequence, digest, answer in answered)
        self._clients[name] = client

    def note(self, name: str, sequence: int, digest: int, answer: object, now: float) -> list[Effect]:
        """Insert `sequence` of client `name` came to the map by way of another journal, and has this answer."""
        client = self._clients.setdefault(name, _Client(heard=now, seen=now))
        waiting = client.open.pop(sequence, None)
        effects: list[Effect] = []
        if waiting is not None:
            self._no_longer_waits(client, waiting)
            same = waiting.digest == digest
            said = answer if same else BadSequence(name, sequence, "a number not used for another insert", sequence + 1)
            effects = [_reply(asker, said, sequence) for asker in waiting.askers]
        client.answered[sequence] = (digest, answer)
        if len(client.answered) > self._limits.remembered:
            client.answered.popitem(last=False)
        client.next = max(client.next, sequence + 1)
        while client.next in client.parked:
            self._parked -= 1
            self._make_ready(client, client.parked.pop(client.next))
        return effects

    def took(self, inserts: int, seconds: float) -> None:
        """Learn the pace: `inserts` were applied `seconds`."""
        if inserts:
            self._pace_s += 0.1 * (seconds / inserts - self._pace_s)

    def _judge(self, arrived: Arrived) -> list[Effect]:
        """Its answer if there is one, nothing if it waits.  Raises Problem."""
        if arrived.epoch not in (0, self._epoch):
            raise WrongEpoch(arrived.epoch, self._epoch)
        client = self._clients.get(arrived.client)
        if client is None:
            client = self._new_client(arrived)
        client.seen = arrived.now
        if arrived.sequence in client.open:
            return self._ask_again(client.open[arrived.sequence], arrived, client.next)
        if arrived.sequence < client.next:
            return [_reply(arrived.askers[0], _remembered(client, arrived), arrived.sequence)]
        if self._closing is not None:
            raise self._closing
        if self._blocked is not None:
            raise self._blocked
        if arrived.is_change:
            self._check_changes(client)
        if arrived.sequence == client.next:
            self._admit_next(client, arrived)
        else:
            self._park(client, arrived)
        self._clients[arrived.client] = client
        return []

    def _new_client(self, arrived: Arrived) -> _Client:
        """A place for a name not seen before; it counts as soon as something of it is taken.

        Every run of a client has a name of its own, so the names of those long silent make room.
        """
        self._check_share(arrived)
        if len(self._clients) >= self._limits.clients:
            name, idlest = min(self._clients.items(), key=lambda item: (bool(item[1].open), item[1].seen))
            if idlest.open or arrived.now - idlest.seen < self._limits.client_idle_s:
                raise TooLarge("the map", len(self._clients) + 1, self._limits.clients, "clients", _LEAVE)
            del self._clients[name]
        return _Client(heard=arrived.now)

    def _check_share(self, arrived: Arrived) -> None:
        """A sender that keeps coming under new names does not use up the names of all: it makes room among its own."""
        sender, share = _sender(arrived.client), max(self._limits.clients // _NAMES_OF_ONE, 1)
        if len(self._clients) < share:
            return
        own = {name: client for name, client in self._clients.items() if _sender(name) == sender}
        if len(own) < share:
            return
        name, idlest = min(own.items(), key=lambda item: (bool(item[1].open), item[1].seen))
        if idlest.open or arrived.now - idlest.seen < _NAME_IDLE_S:
            raise TooLarge(f"{sender} in this map", len(own) + 1, share, "clients", _LEAVE)
        del self._clients[name]

    def _ask_again(self, insert: Arrived, arrived: Arrived, following: int) -> list[Effect]:
        """One more waits for the answer; of too many, the first is told to come back: it has most likely given up."""
        if insert.digest != arrived.digest:
            raise BadSequence(arrived.client, arrived.sequence, "a number not used for another insert", following)
        insert.askers.append(arrived.askers[0])
        if len(insert.askers) <= _ASKERS:
            return []
        return [Refuse(insert.askers.pop(0), self._busy(), min(following, insert.sequence))]

    def _check_changes(self, client: _Client) -> None:
        """Raises Busy where a client has as many changes under way as it may."""
        if len(client.open) >= self._limits.changes:
            under_way = sum(insert.is_change for insert in client.open.values())
            if under_way >= self._limits.changes:
                raise Busy(under_way, self._busy().detail["retry_after_s"], _CHANGES_WAIT)

    def _admit_next(self, client: _Client, arrived: Arrived) -> None:
        """Into the inbox, and with it whatever waited for just this one."""
        client.heard = arrived.now
        # The smallest inbox still takes one insert, whatever its size.
        limits = self._limits
        crowded = self._ready and self._bytes + arrived.size > limits.waiting_bytes
        full = crowded or self._ready >= limits.waiting
        if full and (client.ready or arrived.size > limits.waiting_bytes // limits.clients):
            raise self._busy()
        self._bytes += arrived.size
        self._make_ready(client, arrived)
        while client.next in client.parked:
            self._parked -= 1
            self._make_ready(client, client.parked.pop(client.next))

    def _make_ready(self, client: _Client, insert: Arrived) -> None:
        if not client.ready:
            heappush(self._turns, (max(self._clock, client.served), next(self._order), insert.client))
        client.ready.append(insert)
        client.open[insert.sequence] = insert
        client.next += 1
        self._ready += 1

    def _no_longer_waits(self, client: _Client, insert: Arrived) -> None:
        self._bytes -= insert.size
        if client.parked.pop(insert.sequence, None) is not None:
            self._parked -= 1
            return
        client.ready.remove(insert)
        self._ready -= 1
        if not client.ready:
            self._turns = [turn for turn in self._turns if turn[2] != insert.client]
            heapify(self._turns)

    def _park(self, client: _Client, arrived: Arrived) -> None:
        window = self._limits.waiting
        if arrived.sequence - client.next >= window:
            raise BadSequence(arrived.client, arrived.sequence, _wanted(client), client.next)
        if self._parked >= window or (self._parked and self._bytes + arrived.size > 2 * self._limits.waiting_bytes):
            raise self._busy()
        if not client.parked:
            client.heard = arrived.now
        self._bytes += arrived.size
        self._parked += 1
        client.parked[arrived.sequence] = client.open[arrived.sequence] = arrived

    def _unpark(self, client: _Client, problem: Problem | None) -> list[Effect]:
        """Refuse what `client` has parked; its numbers are not used up."""
        effects: list[Effect] = []
        for sequence, insert in client.parked.items():
            why = problem or BadSequence(insert.client, sequence, _wanted(client), client.next)
            effects += [Refuse(asker, why, client.next) for asker in insert.askers]
            del client.open[sequence]
            self._bytes -= insert.size
        self._parked -= len(client.parked)
        client.parked.clear()
        return effects

    def _busy(self) -> Busy:
        """Come back when half of what waits is likely to be done."""
        waiting = self._ready + self._parked
        least, most = _RETRY_S
        return Busy(waiting, round(min(max(self._pace_s * waiting / 2, least), most), 3))


def _remembered(client: _Client, arrived: Arrived) -> object:
    digest, answer = client.answered.get(arrived.sequence, (None, None))
    if digest != arrived.digest:
        what = "a number not used for another insert" if digest is not None else "one not older than those remembered"
        raise BadSequence(arrived.client, arrived.sequence, f"{what}: {client.next} is next", client.next)
    return answer


def _sender(client: str) -> str:
    """robot1 of robot1-5f3a90c1: the library adds a suffix with every run."""
    return client.rpartition("-")[0] or client


def _wanted(client: _Client) -> str:
    return f"{client.next} first"


def _reply(asker: Asker, answer: object, sequence: int) -> Effect:
    """The final answer to the insert of that number, which is used up."""
    return Answer(asker, answer) if isinstance(answer, bytes) else Refuse(asker, answer, sequence + 1)
