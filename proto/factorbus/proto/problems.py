"""Every way a request can be refused: one tree, one stable code each.  The code travels, the text is for a person.

    Problem
    ├── BadSymbol            bad_symbol           a variable key that cannot be read
    ├── BadName              bad_name             a map, client or worker name outside [A-Za-z0-9_-]{1,64}
    ├── BadEndpoint          bad_endpoint         an address on the bus that cannot be read
    ├── BadSetting           bad_setting          a setting of the connection that the bus does not take
    ├── BadConfigurationFile bad_file             a Zenoh configuration file that cannot be read
    ├── BadInput             (of those below)     something given that is not what is wanted at its place
    │   ├── BadShape         bad_shape            numbers whose count does not fit their kind (client side)
    │   ├── NotFiniteNumbers not_finite           a NaN or an infinity among numbers for a map (client side)
    │   ├── BadInformation   bad_information      an asymmetric information matrix, sigmas that are not positive
    │   └── BadMessage       bad_message          bytes that are not the message they should be
    │       ├── UnknownKind  unknown_kind         a kind of variable, factor or change that this version does not know
    │       ├── BadLoss      bad_loss             a loss that does not exist, a scale that is not positive
    │       └── BadOption    bad_option           a parameter whose value, or type, is not one it takes
    ├── BadExpression        unknown_kind         a formula, or a function for one, that is no kind (`expressions`)
    ├── TooLarge             too_large            a message, an insert or a map over its limit
    ├── BadSequence          bad_sequence         a sequence number that skips or is too old to answer again
    ├── WrongEpoch           wrong_epoch          the map was restarted or recreated since the client joined
    ├── UnknownMap           unknown_map          no such map here
    ├── NotHeld              unknown_variable     a mirror or an answer has no such variable (client side)
    ├── UnknownQuestion      unknown_question     no such question or operation
    ├── Busy                 busy                 the inbox is full: try again after `retry_after_s`
    ├── ShuttingDown         shutting_down        the service is stopping and takes nothing new
    ├── Unavailable          unavailable          nobody answered (client side)
    │   ├── NobodyListens    unavailable          there is nothing at that address
    │   ├── ClosedHere       unavailable          this client itself has closed the connection, or left the map
    │   ├── NoMirror         unavailable          the estimate of a map that was opened without a mirror
    │   └── NotReached       unavailable          a revision was waited for that has not come
    ├── NotConverged         not_converged        a map was waited for in vain (client side)
    ├── BetterOptimum        better_optimum       no refusal: a notice in an answer, that the map is in a worse minimum
    ├── OtherProtocol        other_protocol       only services of another major version are there (client side)
    ├── NotSupported         not_supported        the service is older than what it is asked for (client side)
    ├── Refused              (the code it carries) a problem that came over the bus, as the client sees it
    └── Internal             internal             a fault of the service itself, with a reference into its log

The solver's own errors (unknown_variable, not_positive_definite, underconstrained, ...) carry codes in the same way
(`factorbus.solver.errors`) and travel in the same form.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from factorbus.proto.nearest import few_of, largest_of, nearest
from factorbus.wording.picklable import Picklable

Raised = TypeVar("Raised", bound=Exception)

_NAMED = 12  # maps named where one is asked for that is not there
_FROM = {"values": "the map's own values", "odometry": "composed odometry", "rotations": "averaged rotations"}


class Problem(Picklable, Exception):
    """Base of everything that is answered instead of an answer."""

    code = "problem"
    others: "tuple[Problem, ...]" = ()  # of several that came at once, those after the one that is raised

    def __init__(self, message: str, **detail: Any) -> None:
        self.detail: dict[str, Any] = detail
        super().__init__(message)

    @property
    def message(self) -> str:
        """The text for a person."""
        return str(self.args[0])


def without_frames(problem: Raised) -> Raised:
    """`problem` without its traceback and without what it was raised from: the frames of both hold all that they had,
    whole matrices, for as long as the problem is remembered."""
    problem.__cause__ = problem.__context__ = None
    return problem.with_traceback(None)


class BadSymbol(Problem):
    code = "bad_symbol"

    def __init__(self, text: str, wanted: str) -> None:
        super().__init__(f"variable key {text!r} cannot be read: wanted {wanted}", seen=text, wanted=wanted)


class BadStamp(Problem):
    code = "bad_stamp"

    def __init__(self, where: str, seen: str) -> None:
        wanted = "whole nanoseconds, an int from -2^63 + 1 to 2^63 - 1; of seconds t that is round(t * 1e9)"
        super().__init__(f"{where}: stamp is {seen}; wanted {wanted}", where=where, seen=seen, wanted=wanted)


class BadName(Problem):
    code = "bad_name"

    def __init__(self, what: str, name: str, most: int = 64) -> None:
        wanted = f"1 to {most} of the characters A-Z a-z 0-9 _ -"
        super().__init__(f"{what} name {name!r} will not do: wanted {wanted}", seen=str(name), wanted=wanted)


class BadEndpoint(Problem):
    code = "bad_endpoint"

    def __init__(self, endpoint: str, more: str = "") -> None:
        wanted = f"protocol/address{more and ' '}{more}, such as tcp/127.0.0.1:7447"
        super().__init__(f"endpoint {endpoint!r} cannot be read; wanted {wanted}", seen=endpoint, wanted=wanted)


class BadSetting(Problem):
    code = "bad_setting"

    def __init__(self, path: str, reason: str) -> None:
        wanted = "a path and value of a zenoh configuration"
        super().__init__(f"setting {path!r}: {reason}; wanted {wanted}", seen=path, wanted=wanted)


class BadConfigurationFile(Problem):
    """A Zenoh configuration file.  from_environment: the variable that names it; empty: an argument or option did."""

    code = "bad_file"

    def __init__(self, file: str, reason: str, from_environment: str = "") -> None:
        named = f", which {from_environment} names," if from_environment else ""
        super().__init__(f"the Zenoh configuration {file}{named} cannot be read: {reason}", path=file)


class BadInput(Problem):
    """where: in what was given.  A kind of its own for each thing that a program would do about it."""

    def __init__(self, where: str, seen: object, wanted: str) -> None:
        super().__init__(f"{where}: {seen}; wanted {wanted}", where=where, seen=str(seen), wanted=wanted)


class BadShape(BadInput):
    code = "bad_shape"


class NotFiniteNumbers(BadInput):
    code = "not_finite"

    def __init__(self, where: str, seen: object) -> None:
        super().__init__(where, seen, "finite numbers")


class BadInformation(BadInput):
    code = "bad_information"


class BadMessage(BadInput):
    code = "bad_message"


class BadLoss(BadMessage):
    code = "bad_loss"


class BadOption(BadMessage):
    code = "bad_option"


class UnknownKind(BadMessage):
    code = "unknown_kind"

    def __init__(self, where: str, kind: str, known: tuple[str, ...], also: str = "") -> None:
        meant = largest_of(kind, known) or nearest(kind[:64], filter(str.isidentifier, known))
        listed = few_of(kind, known)
        super().__init__(where, f"kind {kind[:64]!r} is not known here{meant}", f"one of {listed}{also}")
        self.detail["kind"] = kind[:64]


class TooLarge(Problem):
    code = "too_large"

    def __init__(
        self, what: str, size: int, limit: int, unit: str = "", mend: str = "send it in parts or raise the limit"
    ) -> None:
        unit = f" {unit}" if unit else ""
        super().__init__(
            f"{what} has {size}{unit}, the limit is {limit}; {mend}",
            size=size,
            limit=limit,
        )


class BadSequence(Problem):
    code = "bad_sequence"

    def __init__(self, client: str, seen: int, wanted: str, next_sequence: int) -> None:
        super().__init__(
            f"client {client} sent sequence {seen}; wanted {wanted}", seen=str(seen), wanted=wanted, next=next_sequence
        )


class WrongEpoch(Problem):
    code = "wrong_epoch"

    def __init__(self, seen: int, epoch: int) -> None:
        super().__init__(f"the map's epoch is {epoch}, not {seen}: join again and send what it lacks", epoch=epoch)


class UnknownMap(Problem):
    code = "unknown_map"

    def __init__(self, name: str, known: Sequence[str] | None = None) -> None:
        """known: the maps that there are, where that is known."""
        if known is None:
            super().__init__(
                f"there is no map {name!r} here; create it, or list the maps for those there are", map=name
            )
            return
        shown = ", ".join(sorted(known)[:_NAMED]) + (f" and {len(known) - _NAMED} more" if len(known) > _NAMED else "")
        there = f"there are {shown}{nearest(name, known)}" if known else "there is none yet"
        super().__init__(f"there is no map {name!r} here; {there}", map=name, known=sorted(known))


class NotHeld(Problem, KeyError):
    """What is looked up in a mirror or an answer is not in it: as of any mapping of Python's, a KeyError."""

    code = "unknown_variable"

    def __str__(self) -> str:
        return self.message  # a KeyError shows its quotes


class UnknownQuestion(Problem):
    code = "unknown_question"

    def __init__(self, question: str, wanted: str) -> None:
        super().__init__(f"question {question!r} is not understood; wanted {wanted}", seen=question, wanted=wanted)


class SeveralRobots(Problem):
    """A trajectory is one robot's.  robots: the letters of those there are, "" for keys without a letter."""

    code = "several_robots"

    def __init__(self, robot: str | None, robots: tuple[str, ...]) -> None:
        there = ", ".join(letter or "keys without a letter" for letter in robots) or "no pose"
        verb = "is" if len(robots) < 2 and robots != ("",) else "are"
        asked = "none was chosen" if robot is None else f"none is {robot[:8]!r}"
        super().__init__(
            f"a trajectory is one robot's; there {verb} {there}, and {asked}: name one (robot, --robot)",
            robots=list(robots),
        )


class Busy(Problem):
    code = "busy"

    def __init__(
        self, waiting: int, retry_after_s: float, of: str = "inserts are waiting and the inbox is full"
    ) -> None:
        super().__init__(f"{waiting} {of}; send again in {retry_after_s:g} s", retry_after_s=retry_after_s)


class ShuttingDown(Problem):
    code = "shutting_down"

    def __init__(self) -> None:
        super().__init__("the service is shutting down and takes nothing new; send again when it is back")


class Unavailable(Problem):
    code = "unavailable"

    def __init__(self, what: str, waited_s: float, hint: str) -> None:
        super().__init__(f"{what} did not answer within {waited_s:g} s; {hint}", waited_s=waited_s)


class NobodyListens(Unavailable):
    """The address is that of a machine where nothing listens: no service, and no router."""

    def __init__(self, endpoint: str, unresolved: Sequence[str] = ()) -> None:
        """unresolved: names of machines in it that have no address."""
        seen, mend = (
            f"nothing listens at {endpoint}",
            "start a service there with `factorbus serve`, or check the address",
        )
        if unresolved:
            seen = f"{endpoint} leads nowhere: there is no address for the name {' and '.join(unresolved)}"
            mend = "is it spelt right, and does this machine's name service (DNS, /etc/hosts) know it?"
        Problem.__init__(self, f"{seen}; {mend}")


class ClosedHere(Unavailable):
    """Nobody was asked: what it would go over was closed by this client."""

    def __init__(self, what: str, *, connection: bool) -> None:
        """connection: all of it is closed, and not only the map."""
        closed = "this connection is closed; connect again" if connection else "it was closed here; open it again"
        Problem.__init__(self, f"{what.rstrip(',')}: {closed}", waited_s=0.0)


class NoMirror(Unavailable):
    """There is no local copy to read: the map was opened without."""

    def __init__(self, name: str) -> None:
        Problem.__init__(self, f"map {name!r} was opened without a mirror; open it with mirror=True", waited_s=0.0)


class NotReached(Unavailable):
    """The service is there, and the mirror up to date, but not at the revision that was waited for."""

    def __init__(self, name: str, wanted: int, revision: int, waited_s: float) -> None:
        Problem.__init__(
            self,
            f"map {name!r} is at revision {revision}, and has not reached {wanted} within {waited_s:g} s; "
            "wait for the revision of an Accepted, or wait longer",
            revision=revision,
            waited_for=wanted,
            waited_s=waited_s,
        )


class BetterOptimum(Problem):
    """A notice, not a refusal: it comes in the answer to ask/chi2."""

    code = "better_optimum"
    # How far χ² of the map may be above the batch optimum's before it is said.
    SHARE, FLOOR = 0.01, 1e-6

    def __init__(self, chi2: float, batch: float, start: str) -> None:
        by = _FROM.get(start, "another start")
        super().__init__(
            f"the map is in a worse minimum: its χ² is {chi2:.6g}, and {batch:.6g} at an optimum found from {by}; "
            "`factorbus change adopt MAP` puts the map there",
            chi2=chi2,
            batch=batch,
            start=start,
        )

    @classmethod
    def or_none(cls, chi2: float, batch: float, start: str) -> "BetterOptimum | None":
        """The notice, if `batch` is below `chi2` by more than 1 %."""
        return cls(chi2, batch, start) if chi2 > (1.0 + cls.SHARE) * batch + cls.FLOOR else None


class NotConverged(Problem):
    code = "not_converged"

    def __init__(self, name: str, revision: int, waited_s: float, gave_up: str) -> None:
        seen = f"map {name!r} has not converged to its optimum at revision {revision}"
        wanted = f"after {waited_s:g} s; it goes on by itself: wait longer, or look at the stats of the map"
        if gave_up:
            wanted = f"and goes on no more by itself: {gave_up}; `settle` it, or ask `repair` what is wrong in it"
        super().__init__(f"{seen} {wanted}", revision=revision, waited_s=waited_s, gave_up=gave_up)


class Internal(Problem):
    code = "internal"

    def __init__(self, reference: str) -> None:
        super().__init__(f"the service failed on this request and left the map as it was; see {reference} in its log")


class OtherProtocol(Problem):
    code = "other_protocol"

    def __init__(self, versions: list[str], wanted: str) -> None:
        seen = ", ".join(versions)
        super().__init__(
            f"the services here speak version {seen} of the protocol, this client {wanted}, and they do "
            "not hear each other: update the older of the two",
            versions=versions,
            seen=seen,
            wanted=wanted,
        )


class NotSupported(Problem):
    code = "not_supported"

    def __init__(self, what: str, product: str) -> None:
        super().__init__(
            f"the service (factorbus {product or 'of unknown version'}) does not know {what}; nothing was sent: update "
            "the service",
            what=what,
            product=product,
        )


class Refused(Problem):
    """A problem as it arrived over the bus; `code` is the sender's."""

    def __init__(self, code: str, message: str, detail: Mapping[str, Any]) -> None:
        self.code = code
        super().__init__(message, **{str(name): value for name, value in detail.items()})

    def __str__(self) -> str:
        return f"{self.message} [{self.code}]"
