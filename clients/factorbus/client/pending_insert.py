"""What stands for an insert that is on its way."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future

from factorbus.client.arguments import checked_seconds
from factorbus.client.request_sender import Request
from factorbus.proto.codec import encode_insert
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Accepted, Insert
from factorbus.proto.problems import Problem, TooLarge, Unavailable
from factorbus.wording import counted


class PendingInsert:
    """An insert that was sent: it will be delivered once, as long as its map is open here and keeps its epoch."""

    def __init__(self, request: Request, sequence: int, timeout_s: float) -> None:
        self.request = request
        self.sequence = sequence
        self.seen = False
        self.waited_for = False  # in vain, which was said
        self._timeout_s = timeout_s

    @property
    def future(self) -> Future[Accepted]:
        """For callbacks and asyncio; looking at the answer through it counts as having seen it."""
        self.seen = True
        return self.request.future

    @property
    def round_trip_s(self) -> float | None:
        """Seconds from the first sending to the answer; None while there is none."""
        return self.request.answered_at - self.request.sent_at if self.done() else None

    def done(self) -> bool:
        """There is an answer."""
        return self.request.future.done()

    def result(self, timeout_s: float | None = None) -> Accepted:
        """Wait for the answer.  Raises Refused (the map is as it was), or NoAnswerYet, an Unavailable.

        NoAnswerYet does not take the insert back: it goes on being sent with its number.  Wait again, or `flush`;
        do not insert it anew.
        """
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        try:
            return self.future.result(timeout_s)
        except TimeoutError:
            self.seen, self.waited_for = False, True
            raise NoAnswerYet(self, timeout_s) from None


def raise_unseen(refused: Sequence[tuple[PendingInsert, Problem]]) -> None:
    """Raises the first refusal of an insert whose answer nobody has looked at; the further ones are its `others`.

    Of one that was waited for in vain it is known that there was no answer.
    """
    unseen = [
        refusal
        for pending_insert, refusal in refused
        if not (pending_insert.seen or (pending_insert.waited_for and isinstance(refusal, Unavailable)))
    ]
    if not unseen:
        return
    first, *others = unseen
    first.others = tuple(others)
    if others:
        codes = ", ".join(f"{count} {code}" for code, count in Counter(each.code for each in others).items())
        first.add_note(f"{counted(len(others), 'further insert')} refused: {codes}; the first of them: {others[0]}")
    raise first


def encoded(insert: Insert) -> bytes:
    """An insert as it is sent.  Raises TooLarge: the bus would drop it without a word."""
    payload = encode_insert(insert)
    if len(payload) > REQUEST_LIMITS.max_bytes:
        raise TooLarge("the insert", len(payload), REQUEST_LIMITS.max_bytes, "bytes")
    return payload


class NoAnswerYet(Unavailable):
    """An insert's answer did not come in time; `pending_insert` still stands for it."""

    def __init__(self, pending_insert: PendingInsert, waited_s: float) -> None:
        self.pending_insert = pending_insert
        hint = (
            "it keeps being sent with its number: wait on .pending_insert.result() or flush(), do not insert it again"
        )
        what = f"{pending_insert.request.what}, insert {pending_insert.sequence},"
        super().__init__(what, round(waited_s, 3), f"{pending_insert.request.because}; {hint}")
