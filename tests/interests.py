"""A map that only has values, and clients that follow parts of it, for tests of interests: no bus, clock or thread."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np

from factorbus.client.interest_following import InterestFollowing
from factorbus.proto.interest import Interest, checked_interest, filter_of
from factorbus.proto.interest_codec import AskInterest, decode_interest_answer, decode_interest_delta
from factorbus.proto.messages import Delta, Variables
from factorbus.service.config import Limits
from factorbus.service.core.events import Answer, Follow, Publish, Refuse
from factorbus.service.interests.core import FetchEstimate, InterestCore
from factorbus.service.interests.stream import CARRIED_BYTES

SIZES = {"se2": 3, "se3": 7, "point2": 2, "vector1": 1}
Values = dict[tuple[str, int], tuple[float, ...]]


@dataclass
class World:
    """The map.  history: what it was at each revision of this epoch."""

    epoch: int = 7
    values: Values = field(default_factory=dict)
    history: list[Values] = field(default_factory=lambda: [{}])

    @property
    def revision(self) -> int:
        return len(self.history) - 1

    def step(self, changed: Values) -> Delta:
        self.values = self.values | changed
        self.history.append(self.values)
        return Delta(self.epoch, self.revision, self.revision - 1, groups(changed), {"converged": True})

    def without(self, gone: Iterable[tuple[str, int]]) -> Delta:
        self.values = {each: value for each, value in self.values.items() if each not in set(gone)}
        self.history.append(self.values)
        return Delta(self.epoch, self.revision, 0, groups(self.values), {"converged": True})

    def begin_anew(self) -> None:
        self.epoch, self.values, self.history = self.epoch + 1, {}, [{}]


def groups(values: Values) -> tuple[Variables, ...]:
    kinds = dict.fromkeys(kind for kind, _ in values)
    found = []
    for kind in kinds:
        keys = [key for of, key in values if of == kind]
        rows = np.array([values[kind, key] for key in keys], float).reshape(-1, SIZES[kind])
        found.append(Variables(kind, np.array(keys), rows))
    return tuple(found)


def held(variables: Iterable[Variables]) -> Values:
    return {
        (group.kind, int(key)): tuple(row)
        for group in variables
        if group.values is not None
        for key, row in zip(group.keys, group.values.tolist(), strict=True)
    }


def part(interest: Interest, values: Values) -> Values:
    return held(filter_of(interest).pick(groups(values)))


class Follower:
    """A client of one interest.  `deaf`: it misses what is published."""

    def __init__(self, interest: Interest) -> None:
        self.interest, self.following, self.deaf, self.asking = (
            checked_interest(interest),
            InterestFollowing(),
            0,
            False,
        )
        self.epoch = 0

    def question(self) -> AskInterest:
        following = self.following
        return AskInterest(self.interest, bool(following.channel), following.stream, following.number)

    def answered(self, message: bytes) -> None:
        answer = decode_interest_answer(message)
        self.asking = False
        if self.following.channel:
            self.following.answer(answer)
        self.following.channel = answer.channel

    def hear(self, channel: str, message: bytes) -> None:
        if channel == self.following.channel and self.deaf:
            self.deaf -= 1
        elif channel == self.following.channel:
            self.following.message(decode_interest_delta(message))

    @property
    def values(self) -> Values:
        return held(self.following.values.variables())


class Service:
    """The interests in one map, with followers that hear of everything at once."""

    def __init__(self, world: World, **limits: Any) -> None:
        self.world, self.now, self.followers = world, 0.0, list[Follower]()
        numbers = count(1)
        self.core = InterestCore("m", Limits(**limits), lambda: next(numbers))
        self.sent: list[tuple[float, str, int]] = []  # when, on which channel, bytes
        self.refused: list[Any] = []
        self.ended: list[str] = []
        self.copies = 0

    def join(self, interest: Interest) -> Follower:
        follower = Follower(interest)
        self.followers.append(follower)
        return follower

    def ask(self, follower: Follower) -> None:
        """Ask as a mirror does: until it follows, or for what it lacks."""
        if not follower.asking:
            follower.asking = True
            row = {"epoch": self.world.epoch, "revision": self.world.revision, "converged": True, "converging": False}
            self.perform(self.core.asked(Follow(follower, follower.question(), row), self.now))

    def step(self, delta: Delta) -> None:
        self.perform(self.core.delta(delta, self.now))

    def wait(self, seconds: float) -> None:
        """Time goes by, and what is due then is done when it is."""
        end, ticks = self.now + seconds, 0
        while (due := self.core.next_due(self.now)) is not None and due <= end:
            self.now, ticks = max(self.now, due), ticks + 1
            assert ticks < 10_000, "what is due again and again, and not done, keeps a core busy"
            self.perform(self.core.tick(self.now))
        self.now = end

    def settle(self) -> None:
        """Until every follower has what there is."""
        for _ in range(200):
            for follower in self.followers:
                if not follower.following.live or follower.following.revision < self.world.revision:
                    self.ask(follower)
            self.wait(0.5)
            if all(self.has_all(each) for each in self.followers):
                return

    def has_all(self, follower: Follower) -> bool:
        following = follower.following
        return following.live and following.revision == self.world.revision and not following.waiting

    def perform(self, effects: Iterable[Any]) -> None:
        for effect in effects:
            if isinstance(effect, Publish):
                self.sent.append((self.now, effect.channel, len(effect.message) + CARRIED_BYTES))
                for follower in self.followers:
                    follower.hear(effect.channel, effect.message)
            elif isinstance(effect, Answer):
                answer = decode_interest_answer(effect.message)
                if answer.variables or answer.gone:
                    self.sent.append((self.now, answer.channel, len(effect.message) + CARRIED_BYTES))
                effect.asker.answered(effect.message)
            elif isinstance(effect, Refuse):
                effect.asker.asking = False
                self.refused.append(effect.problem)
            elif isinstance(effect, FetchEstimate):
                self.copies += 1
                world = self.world
                self.perform(self.core.copied(effect, world.epoch, world.revision, groups(world.values), self.now))
            else:
                self.ended.append(effect.channel)
