"""Bytes of the question ask/interest, its answer and what an interest's channel carries, both ways.

Every reader raises BadMessage (UnknownKind and BadOption are such), TooLarge.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto import fields
from factorbus.proto.codec import encode_map
from factorbus.proto.columns import read_values, variables_to_maps
from factorbus.proto.fields import F8, Map
from factorbus.proto.interest import Interest, InterestFilter, checked_interest, filter_of
from factorbus.proto.limits import ANSWER_LIMITS, REQUEST_LIMITS, MessageLimits
from factorbus.proto.messages import Variables
from factorbus.proto.problems import BadMessage
from factorbus.wording import counted

# The parameters of ask/estimate and ask/interest that say which variables.
FILTER_FIELDS = ("letters", "kinds", "box")


class AskInterest(NamedTuple):
    """The question.  following: the asker listens on the channel, and wants what it lacks.

    stream, number: what it has, of an earlier answer and the last message; 0: nothing.
    """

    interest: Interest
    following: bool = False
    stream: int = 0
    number: int = 0


class InterestAnswer(NamedTuple):
    """What an interest is called, and what the asker lacks.

    stream: one life of the channel, whose messages are numbered; `number` is that of the last.  whole: let go of what
    you have, `variables` are the first of all; else they, and those of `gone` (without values), are what was missed.
    waiting: variables that are still to come on the channel.  converged, converging: of the map at `revision`, None:
    not known.
    """

    epoch: int
    revision: int
    channel: str
    stream: int
    number: int
    lease_s: float
    whole: bool = False
    variables: tuple[Variables, ...] = ()
    gone: tuple[Variables, ...] = ()
    waiting: int = 0
    converged: bool | None = None
    converging: bool | None = None


class InterestDelta(NamedTuple):
    """What the channel of an interest carries: `gone` (without values) leave it, then `variables` have new values.

    previous: the revision of the message before.  waiting: variables that are still to come, older than `revision`.
    """

    epoch: int
    revision: int
    previous: int
    stream: int
    number: int
    variables: tuple[Variables, ...] = ()
    gone: tuple[Variables, ...] = ()
    waiting: int = 0
    converged: bool | None = None
    converging: bool | None = None


def filter_map(interest: Interest) -> dict[str, Any]:
    """The fields that say which variables an interest is about."""
    content: dict[str, Any] = {}
    for name in ("letters", "kinds"):
        if words := list(getattr(interest, name)):
            content[name] = words
    if box := list(interest.box):
        content["box"] = np.asarray(box, F8).tobytes()
    return content


def read_filter(content: Map, where: str = "question") -> InterestFilter | None:
    """The filter in a question; None: there is none."""
    if all(content.get(name) is None for name in FILTER_FIELDS):
        return None
    return filter_of(_read_interest(content, where), where)


def encode_ask_interest(ask: AskInterest) -> bytes:
    """The bytes of the question, its interest being checked."""
    interest = ask.interest
    content = filter_map(interest) | {"period_ms": interest.period_ms}
    if interest.bytes_per_s:
        content["bytes_per_s"] = interest.bytes_per_s
    if ask.following:
        content["following"] = True
    if ask.stream:
        content |= {"stream": ask.stream, "number": ask.number}
    return encode_map(content)


def decode_ask_interest(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskInterest:
    """The question."""
    content = fields.read_map("question", data, limits) if data else {}
    interest = _read_interest(content, "question")
    period_ms = fields.integer("question", content, "period_ms", default=interest.period_ms)
    bytes_per_s = fields.integer("question", content, "bytes_per_s", default=0)
    interest = Interest(interest.letters, interest.kinds, interest.box, period_ms, bytes_per_s)
    stream, number = (fields.integer("question", content, name, default=0) for name in ("stream", "number"))
    return AskInterest(
        checked_interest(interest, "question"), fields.flag("question", content, "following"), stream, number
    )


def encode_interest_answer(message: InterestAnswer) -> bytes:
    """The bytes of the answer to ask/interest."""
    content: dict[str, Any] = {name: getattr(message, name) for name in _ANSWER_FIELDS}
    if message.whole:
        content["whole"] = True
    return encode_map(content | _variables_part(message))


def decode_interest_answer(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> InterestAnswer:
    """The answer to ask/interest."""
    content = fields.read_map("interest", data, limits)
    return InterestAnswer(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        channel=fields.text("", content, "channel"),
        stream=fields.integer("", content, "stream"),
        number=fields.integer("", content, "number"),
        lease_s=fields.number("", content, "lease_s"),
        whole=fields.flag("", content, "whole"),
        **_read_variables_part(content),
    )


def encode_interest_delta(message: InterestDelta) -> bytes:
    """The bytes of a message of an interest's channel."""
    return encode_map({name: getattr(message, name) for name in _DELTA_FIELDS} | _variables_part(message))


def decode_interest_delta(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> InterestDelta:
    """A message of an interest's channel."""
    content = fields.read_map("interest", data, limits)
    return InterestDelta(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        previous=fields.integer("", content, "previous"),
        stream=fields.integer("", content, "stream"),
        number=fields.integer("", content, "number"),
        **_read_variables_part(content),
    )


_ANSWER_FIELDS = ("epoch", "revision", "channel", "stream", "number", "lease_s")
_DELTA_FIELDS = ("epoch", "revision", "previous", "stream", "number")


def _read_variables_part(content: fields.Map) -> dict[str, Any]:
    """What an answer and a message of the channel have alike."""
    return {
        "variables": read_values(content),
        "gone": _read_gone(content),
        "waiting": fields.integer("", content, "waiting", default=0),
        "converged": _optional_flag(content, "converged"),
        "converging": _optional_flag(content, "converging"),
    }


def _variables_part(message: InterestAnswer | InterestDelta) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for name in ("variables", "gone"):
        if groups := getattr(message, name):
            content[name] = variables_to_maps(groups)
    for name in ("waiting", "converged", "converging"):
        if value := getattr(message, name):
            content[name] = value
        elif value is False:
            content[name] = False
    return content


def _read_interest(content: Map, where: str) -> Interest:
    """The filter of an interest, not checked beyond its types."""
    letters, kinds = (_read_words(content, name, where) for name in ("letters", "kinds"))
    box: Sequence[float] = ()
    if content.get("box") is not None:
        data = fields.binary(where, content, "box")
        if len(data) not in (32, 48):
            raise BadMessage(f"{where}.box", counted(len(data), "byte"), "32 or 48 (4 or 6 float64)")
        box = np.frombuffer(data, F8).tolist()
    return Interest(letters, kinds, box)


def _read_words(content: Map, name: str, where: str) -> tuple[str, ...]:
    value = content.get(name)
    if value is None:
        return ()
    if type(value) is not list or not all(type(word) is str for word in value):
        raise BadMessage(f"{where}.{name}", "no array of strings", "an array of strings")
    return tuple(value)


def _read_gone(content: Map) -> tuple[Variables, ...]:
    groups = []
    for index, group in enumerate(fields.maps("", content, "gone")):
        place = f"gone[{index}]"
        keys = fields.keys(lambda place=place: place, group, 0)
        groups.append(Variables(fields.text(place, group, "kind"), keys))
    return tuple(groups)


def _optional_flag(content: Map, name: str) -> bool | None:
    return fields.flag("", content, name) if content.get(name) is not None else None
