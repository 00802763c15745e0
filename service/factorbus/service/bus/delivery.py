"""What maps want done is done: answers to inserts and publications leave in order, and large ones hold up nobody else.

A SIGSTOPped client cannot hold up the others: deltas to it are dropped (lower priority than answers, so that they do
not stand in their way), and answers to it wait in its own queue; a large one that fills it costs one of the answering
executors a second, then Zenoh closes that client's transport.  Refusals have an executor of their own: of these a
client can have filled its queue with tens of thousands before the first is taken.  So have answers that are still to
be computed, which may take a minute: what is ready, such as stats, does not wait for them.
"""

import logging
import secrets
from collections.abc import Callable, Sequence
from typing import Any

from factorbus.proto import codec
from factorbus.proto.problems import Busy, Internal, Problem
from factorbus.service.bus.zenoh_session import MapPlace, refuse, reply
from factorbus.service.core.events import Answer, Asker, Drained, Effect, Follow, Publish, Read, Refuse, Tell
from factorbus.service.interests.running import Interests, MapInterests, hand_copy
from factorbus.service.maps.serial_executor import SerialExecutor, SerialExecutors
from factorbus.service.questions.answers import Question, QuestionCopies, answer, check_ready, is_computed
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

_AT_ONCE_BYTES = 64 << 10
_ANSWERERS, _COMPUTERS = 4, 2
_RETRY_S = 1.0  # where many answers are still to be computed


class Delivery:
    """The outbox, the executors that answer, that compute answers, that of refusals, and what goes on which.

    interests: of all maps, to be set.  most: answers that may wait to be computed.  about: what this service adds to
    the stats of a map.  batch: finds batch optima; (asker, question, copies).  copied: the same with a copy of a map,
    which is to be another one.
    """

    def __init__(
        self,
        most: int,
        about: Callable[[], dict[str, Any]],
        batch: Callable[[Asker, Question, QuestionCopies], None],
        copied: Callable[[Asker, Question, QuestionCopies], None],
    ) -> None:
        self.outbox, self.refusals, self._answers = (
            SerialExecutor("outbox"),
            SerialExecutor("refusals"),
            SerialExecutors("answers", _ANSWERERS),
        )
        self._computed, self._most = SerialExecutors("computed", _COMPUTERS), most
        self._about, self._batch, self._copied = about, batch, copied
        self.interests: Interests

    def of_map(self, place: MapPlace, tell: Callable[[], dict[str, Any]], drained: Callable[[], None]) -> "MapDelivery":
        """For a map at `place`; `tell` adds to its stats, `drained` hears that nothing waits any more.

        `interests` of it is to be set, when the map is there that they ask.
        """
        return MapDelivery(self, place, tell, drained)

    def answer(self, asker: Asker, message: bytes) -> None:
        """Answer, however large, however slow."""
        self._answers.hand(reply, asker, message)

    def refuse(self, asker: Asker, problem: Any) -> None:
        """The same with a problem."""
        self._answers.hand(refuse, asker, problem)

    def settle(self) -> None:
        """Return when all answers that were handed in are sent, and interests have ended."""
        self.interests.close()
        self._computed.settle()
        self._answers.settle()

    def close(self) -> None:
        """Return when everything is sent."""
        self._computed.close()
        self._answers.close()
        self.refusals.close()
        self.outbox.close()

    # ---- on the answering executors: who does not take an answer holds up one of them for a second ------------

    def tell(self, asker: Asker, content: dict[str, Any]) -> None:
        """Answer with `content` and what the service adds."""
        self._answers.hand(lambda: reply(asker, codec.encode_map({**content, **self._about()})))

    def read(self, place: MapPlace, read: Read, taken: QuestionCopies) -> None:
        """Answer `read` from `taken`."""
        if not is_computed(read.question, taken):
            self._answers.hand(self._read, place, read, taken)
        elif (waiting := self._computed.waiting) < self._most:
            self._computed.hand(self._read, place, read, taken)
        else:
            self.refusals.hand(refuse, read.asker, Busy(waiting, _RETRY_S))

    def _read(self, place: MapPlace, read: Read, taken: QuestionCopies) -> None:
        try:
            check_ready(read.question, taken)
            if read.question.name == "snapshot":
                # Behind the delta of the same revision: a mirror that had the snapshot first would skip the delta.
                self.outbox.hand(place.publish, "snapshot", answer(read.question, taken))
            elif read.question.name == "copy":
                self._copied(read.asker, read.question, taken)
            elif read.question.name == "interest":
                hand_copy(read.question, taken)
            elif read.question.batch:
                self._batch(read.asker, read.question, taken)
            else:
                reply(read.asker, answer(read.question, taken))
        except (Problem, SolverError) as problem:
            if read.asker is not None:
                refuse(read.asker, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: answering %s", reference, read.question.name)
            if read.asker is not None:
                refuse(read.asker, Internal(reference))


class MapDelivery:
    """The same for one map: what its host calls.  Returns at once, except `send` where nothing goes before."""

    def __init__(
        self, all_: Delivery, place: MapPlace, tell: Callable[[], dict[str, Any]], drained: Callable[[], None]
    ) -> None:
        self._all, self._place, self._tell, self._drained = all_, place, tell, drained
        self.interests: MapInterests

    def perform(self, effects: list[Effect]) -> None:
        """Hand on what a map wants done: what is to be sent in one piece to the outbox, in order."""
        sending: list[Effect] = []
        for effect in effects:
            if isinstance(effect, Tell):
                self._all.tell(
                    effect.asker, {**effect.content, **self._tell(), "interests": self.interests.core.rows()}
                )
            elif isinstance(effect, Follow):
                self.interests.follow(effect)
            elif isinstance(effect, Drained):
                self.interests.close()
                self._drained()
            elif isinstance(effect, Refuse):
                if effect.asker is not None:  # else it was the service's own question
                    self._all.refusals.hand(refuse, effect.asker, effect.problem, effect.following)
            else:
                sending.append(effect)
        if sending:
            self._all.outbox.hand(_send, self._place, sending)

    def send(self, effects: list[Effect]) -> None:
        """On this thread, unless something else has to go before, or it is more than surely fits into Zenoh's queue.

        That might wait in vain to be emptied: this thread may be the one that does it.
        """
        sending: list[Answer | Publish] = []
        size = 0
        for effect in effects:
            if isinstance(effect, Answer | Publish):
                sending.append(effect)
                size += len(effect.message)
            elif isinstance(effect, Refuse):
                self._all.refusals.hand(refuse, effect.asker, effect.problem, effect.following)
        if sending:
            hand = self._all.outbox.hand_or_do if size <= _AT_ONCE_BYTES else self._all.outbox.hand
            hand(_send, self._place, sending)

    def send_both(self, asker: Asker, message: bytes, delta: bytes) -> None:
        """What was written in one piece is small enough to be sent at once."""
        self._all.outbox.hand_or_do(_send_both, self._place, asker, message, delta)

    def answer_reads(self, reads: Sequence[Read], taken: QuestionCopies) -> None:
        """Answer `reads` from `taken`, elsewhere."""
        for read in reads:
            self._all.read(self._place, read, taken)


def _send(place: MapPlace, effects: list[Effect]) -> None:
    """On the outbox, or on the thread that made the step."""
    for effect in effects:
        if isinstance(effect, Answer):
            reply(effect.asker, effect.message)
        elif isinstance(effect, Publish):
            place.publish(effect.channel, effect.message)


def _send_both(place: MapPlace, asker: Asker, message: bytes, delta: bytes) -> None:
    reply(asker, message)
    place.publish("delta", delta)
