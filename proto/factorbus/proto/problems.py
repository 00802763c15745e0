"""Every way a request can be refused: one tree, one stable code each.  The code travels, the text is for a person.

    Problem
    ├── BadSymbol            bad_symbol           a variable key that cannot be read
    ├── BadName              bad_name             a map, client or worker name outside [A-Za-z0-9_-]{1,64}
    ├── BadEndpoint          bad_endpoint         an address on the bus that cannot be read
    ├── BadSetting           bad_setting          a setting of the connection that the bus does not take
    ├── BadShape             bad_shape            numbers whose count does not fit their kind (client side)
    ├── BadInformation       bad_information      an asymmetric information matrix, sigmas that are not positive
    ├── BadLoss              bad_loss             a loss that does not exist, a scale that is not positive
    ├── BadMessage           bad_message          bytes that are not the message they should be
    │   └── UnknownKind      unknown_kind         a kind of variable or factor that this version does not know
    ├── TooLarge             too_large            a message, an insert or a map over its limit
    ├── BadSequence          bad_sequence         a sequence number that skips or is too old to answer again
    ├── WrongEpoch           wrong_epoch          the map was restarted or recreated since the client joined
    ├── UnknownMap           unknown_map          no such map here
    ├── UnknownQuestion      unknown_question     no such question, or parameters it does not take
    ├── Busy                 busy                 the inbox is full: try again after `retry_after_s`
    ├── ShuttingDown         shutting_down        the service is stopping and takes nothing new
    ├── Unavailable          unavailable          nobody answered (client side)
    ├── Refused              (the code it carries) a problem that came over the bus, as the client sees it
    └── Internal             internal             a fault of the service itself, with a reference into its log

The solver's own errors (unknown_variable, not_positive_definite, underconstrained, ...) carry codes in the same way
(`factorbus.solver.errors`) and travel in the same form.
"""

from collections.abc import Mapping
from typing import Any


class Problem(Exception):
    """Base of everything that is answered instead of an answer."""

    code = "problem"

    def __init__(self, message: str, **detail: Any) -> None:
        self.detail: dict[str, Any] = detail
        super().__init__(message)

    @property
    def message(self) -> str:
        """The text for a person."""
        return str(self.args[0])


class BadSymbol(Problem):
    code = "bad_symbol"

    def __init__(self, text: str, wanted: str) -> None:
        super().__init__(f"variable key {text!r} cannot be read: wanted {wanted}", seen=text)


class BadName(Problem):
    code = "bad_name"

    def __init__(self, what: str, name: str) -> None:
        super().__init__(
            f"{what} name {name!r} will not do: wanted 1 to 64 of the characters A-Z a-z 0-9 _ -", seen=name
        )


class BadEndpoint(Problem):
    code = "bad_endpoint"

    def __init__(self, endpoint: str) -> None:
        super().__init__(
            f"endpoint {endpoint!r} cannot be read; wanted protocol/address, such as tcp/127.0.0.1:7447", seen=endpoint
        )


class BadSetting(Problem):
    code = "bad_setting"

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(f"setting {path!r}: {reason}; wanted a path and value of a zenoh configuration", seen=path)


class BadShape(Problem):
    code = "bad_shape"

    def __init__(self, where: str, seen: object, wanted: str) -> None:
        super().__init__(f"{where}: {seen}; wanted {wanted}", where=where)


class BadInformation(Problem):
    code = "bad_information"

    def __init__(self, where: str, seen: object, wanted: str) -> None:
        super().__init__(f"{where}: {seen}; wanted {wanted}", where=where)


class BadLoss(Problem):
    code = "bad_loss"

    def __init__(self, where: str, seen: object, wanted: str) -> None:
        super().__init__(f"{where}: of the loss seen {seen}; wanted {wanted}", where=where)


class BadMessage(Problem):
    code = "bad_message"

    def __init__(self, where: str, seen: str, wanted: str) -> None:
        super().__init__(f"{where}: {seen}; wanted {wanted}", where=where)


class UnknownKind(BadMessage):
    code = "unknown_kind"

    def __init__(self, where: str, kind: str, known: tuple[str, ...]) -> None:
        super().__init__(where, f"kind {kind[:64]!r} is not known here", f"one of {', '.join(known)}")
        self.detail["kind"] = kind[:64]


class TooLarge(Problem):
    code = "too_large"

    def __init__(self, what: str, size: int, limit: int, unit: str = "") -> None:
        unit = f" {unit}" if unit else ""
        super().__init__(
            f"{what} has {size}{unit}, the limit is {limit}{unit}; send it in parts or raise the limit",
            size=size,
            limit=limit,
        )


class BadSequence(Problem):
    code = "bad_sequence"

    def __init__(self, client: str, seen: int, wanted: str, next_sequence: int) -> None:
        super().__init__(f"client {client} sent sequence {seen}; wanted {wanted}", seen=seen, next=next_sequence)


class WrongEpoch(Problem):
    code = "wrong_epoch"

    def __init__(self, seen: int, epoch: int) -> None:
        super().__init__(f"the map's epoch is {epoch}, not {seen}: join again and send what it lacks", epoch=epoch)


class UnknownMap(Problem):
    code = "unknown_map"

    def __init__(self, name: str) -> None:
        super().__init__(f"there is no map {name!r} here; create it, or ask admin/maps for those there are", map=name)


class UnknownQuestion(Problem):
    code = "unknown_question"

    def __init__(self, question: str, wanted: str) -> None:
        super().__init__(f"question {question!r} is not understood; wanted {wanted}", seen=question)


class Busy(Problem):
    code = "busy"

    def __init__(self, waiting: int, retry_after_s: float) -> None:
        super().__init__(
            f"{waiting} inserts are waiting and the inbox is full; send again in {retry_after_s:g} s",
            retry_after_s=retry_after_s,
        )


class ShuttingDown(Problem):
    code = "shutting_down"

    def __init__(self) -> None:
        super().__init__("the service is shutting down and takes nothing new; send again when it is back")


class Unavailable(Problem):
    code = "unavailable"

    def __init__(self, what: str, waited_s: float, hint: str) -> None:
        super().__init__(f"{what} did not answer within {waited_s:g} s; {hint}", waited_s=waited_s)


class NotConverged(Problem):
    code = "not_converged"

    def __init__(self, name: str, revision: int, waited_s: float, gave_up: str) -> None:
        seen = f"map {name!r} has not converged at revision {revision}"
        wanted = f"after {waited_s:g} s; it goes on by itself: wait longer, or look at ask/stats"
        if gave_up:
            wanted = f"and goes on no more by itself: {gave_up}; `settle` it, or ask `repair` what is wrong in it"
        super().__init__(f"{seen} {wanted}", revision=revision, waited_s=waited_s, gave_up=gave_up)


class Internal(Problem):
    code = "internal"

    def __init__(self, reference: str) -> None:
        super().__init__(f"the service failed on this request and left the map as it was; see {reference} in its log")


class Refused(Problem):
    """A problem as it arrived over the bus; `code` is the sender's."""

    def __init__(self, code: str, message: str, detail: Mapping[str, Any]) -> None:
        self.code = code
        super().__init__(message, **{str(name): value for name, value in detail.items()})

    def __str__(self) -> str:
        return f"{self.message} [{self.code}]"
