"""Following a part of a map's estimate by the messages of an interest's channel.  Pure, as `following` is.

Messages are numbered.  Who has all of them up to the last has the part, but for what the service says is waiting.  One
that is missing is asked for: the answer has what was missed, or everything.
"""

from collections import deque

from factorbus.client.following import Following
from factorbus.client.held_values import HeldValues
from factorbus.proto.interest_codec import InterestAnswer, InterestDelta
from factorbus.proto.messages import Delta, Variables

_KEPT_ASIDE = 256


class InterestFollowing(Following):
    """As `Following` for its readers; what comes in is of a channel."""

    def __init__(self) -> None:
        super().__init__()
        self.channel = ""
        self.stream = self.number = self.waiting = 0
        self.lease_s = 0.0
        self._messages: deque[InterestDelta] = deque(maxlen=_KEPT_ASIDE)

    def message(self, message: InterestDelta) -> list[Delta]:
        """A message came.  Returns what is new to the readers; afterwards `live` says whether an answer is wanted."""
        same = (message.epoch, message.stream) == (self.epoch, self.stream)
        if self.live and same and message.number <= self.number:
            return []
        if self.live and same and message.number == self.number + 1:
            return [self._take(message, message.gone)]
        self.live = False
        self._messages.append(message)
        return []

    def answer(self, answer: InterestAnswer) -> list[Delta]:
        """An answer came to who follows.  Returns what is new to the readers."""
        same = (answer.epoch, answer.stream) == (self.epoch, self.stream)
        self.lease_s = answer.lease_s
        if self.live and same and answer.number < self.number:
            return []  # it crossed messages that are here
        if not (same or answer.whole) or (not answer.whole and answer.number < self.number):
            self.live = False  # it is of what is no more: ask again
            return []
        news: list[Delta] = []
        if answer.whole:
            self.values = HeldValues()
            self.epoch, self.stream, self.revision = answer.epoch, answer.stream, 0
            news.append(self._take(answer, ()))
        elif answer.variables or answer.gone or answer.number > self.number:
            news.append(self._take(answer, answer.gone))
        elif not answer.waiting:
            self.revision = answer.revision  # nothing happened that matters
            self._be_converged(answer)
        self.live = True
        aside = list(self._messages)
        self._messages.clear()
        for message in aside:
            if message.stream == self.stream:
                news += self.message(message)
        return news

    def _take(self, came: InterestDelta | InterestAnswer, gone: tuple[Variables, ...]) -> Delta:
        previous = self.revision
        self.values.remove(gone)
        self.values.put(came.variables)
        self.revision, self.number, self.waiting = came.revision, came.number, came.waiting
        self._be_converged(came)
        # Who only hears of what is new would keep what has left.
        variables, previous = (self.values.variables(), 0) if gone else (came.variables, previous)
        told = {"converged": came.converged, "converging": came.converging}
        return Delta(self.epoch, self.revision, previous, variables, {k: v for k, v in told.items() if v is not None})

    def _be_converged(self, came: InterestDelta | InterestAnswer) -> None:
        self.converged, self.converging = came.converged, came.converging
