"""Messages of inverse-depth features to bytes and back; the rules are those of `codec`.

Decoders raise BadMessage, BadCamera or TooLarge and nothing else, and return arrays that are views into the message.
Whether numbers are finite is not judged here: that is done where they are computed with.
"""

from collections.abc import Callable, Iterable
from typing import Any, cast

import msgpack
import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import F64
from factorbus.proto.camera import Camera
from factorbus.proto.features import (
    CAMERA_STATE,
    FEATURE,
    FORMS,
    Ask,
    Done,
    FeaturesAnswer,
    Observations,
    Segment,
    Shard,
    ShardDone,
)
from factorbus.proto.fields import F8, Map
from factorbus.proto.limits import ANSWER_LIMITS, REQUEST_LIMITS, MessageLimits
from factorbus.proto.problems import BadMessage
from factorbus.wording import counted

_pack = cast(Callable[..., bytes], msgpack.packb)
_OPTIONAL = ("rows", "cross", "blocks", "turn", "own", "U", "S")


def encode_ask(message: Ask) -> bytes:
    """The bytes of a filter front end's question."""
    seen, camera = message.observations, message.observations.camera
    lens: dict[str, Any] = {"model": camera.model, "numbers": _column(camera.numbers)}
    if camera.width:
        lens |= {"width": camera.width, "height": camera.height}
    content: dict[str, Any] = {
        "form": message.form,
        "camera": lens,
        "state": _column(seen.state),
        "covariance": _column(seen.covariance),
        "pixels": _column(seen.pixels),
        "rho": float(seen.rho),
        "sigma_rho": float(seen.sigma_rho),
        "sigma_pixel": float(seen.sigma_pixel),
    }
    if message.segment is not None:
        content["segment"] = message.segment._asdict()
    return _pack(content)


def decode_ask(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> Ask:
    """The question that `data` is.  Raises BadMessage, BadCamera, TooLarge."""
    content = fields.read_map("ask", data, limits)
    form = fields.choice_of("", content, "form", FORMS, "rows")
    observations = Observations(
        _camera(fields.mapping("", content, "camera")),
        _array(content, "state", CAMERA_STATE).reshape(-1)[:CAMERA_STATE],
        _array(content, "covariance", CAMERA_STATE).reshape(CAMERA_STATE, -1),
        _array(content, "pixels", 2).reshape(-1, 2),
        *(fields.number("", content, name) for name in ("rho", "sigma_rho", "sigma_pixel")),
    )
    if len(content["state"]) != 8 * CAMERA_STATE:
        raise BadMessage("state", counted(len(content["state"]), "byte"), f"{8 * CAMERA_STATE} (13 float64)")
    return Ask(observations, form, _segment(content))


def encode_shard(message: Shard) -> bytes:
    """The bytes of a job of kind `idp`."""
    return _pack({"ask": message.ask, "first": message.first, "last": message.last})


def decode_shard(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Shard:
    """The payload of a job of kind `idp` that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("shard", data, limits)
    first = fields.integer("", content, "first")
    return Shard(fields.binary("", content, "ask"), first, fields.integer("", content, "last", least=first))


def encode_shard_done(message: ShardDone) -> bytes:
    """The bytes of the result of a job of kind `idp`."""
    content: dict[str, Any] = {"first": message.first, "last": message.last, "y": _column(message.y)}
    for name in _OPTIONAL:
        if (array := getattr(message, name)) is not None:
            content[name] = _column(array)
    if message.stored:
        content["stored"] = True
    return _pack(content)


def decode_shard_done(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> ShardDone:
    """The result of a job of kind `idp` that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("shard_done", data, limits)
    first = fields.integer("", content, "first")
    last = fields.integer("", content, "last", least=first)
    k = last - first
    heights = {"rows": FEATURE * k, "cross": FEATURE * k, "blocks": 0, "turn": k, "own": k, "U": 6, "S": 3}
    widths = {"turn": 4, "own": 3, "S": 3}
    parts = {name: _part(content, name, heights[name], widths.get(name)) for name in _OPTIONAL}
    y = fields.rows(lambda: "shard_done", content, "y", k, FEATURE)
    return ShardDone(first, last, y, **parts, stored=fields.flag("", content, "stored"))


def encode_answer(shards: Iterable[tuple[bytes, str, float]], clean: bool) -> bytes:
    """The bytes of the answer to an ask: (shard's bytes, worker, seconds) in the order of the features."""
    return _pack({"shards": [{"shard": s, "worker": worker, "seconds": t} for s, worker, t in shards], "clean": clean})


def decode_answer(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> FeaturesAnswer:
    """The answer to an ask that `data` is.  Raises BadMessage, TooLarge."""
    content = fields.read_map("answer", data, limits)
    done = tuple(
        Done(
            decode_shard_done(fields.binary(f"shards[{i}]", each, "shard"), limits),
            fields.text(f"shards[{i}]", each, "worker"),
            fields.number(f"shards[{i}]", each, "seconds"),
        )
        for i, each in enumerate(fields.maps("", content, "shards"))
    )
    return FeaturesAnswer(done, fields.flag("", content, "clean"))


def _column(numbers: Any) -> memoryview:
    """As msgpack takes it without a copy."""
    return np.ascontiguousarray(numbers, F8).reshape(-1).data.cast("B")


def _array(content: Map, name: str, multiple: int) -> F64:
    """The column `name`, whose count of numbers is a multiple of `multiple`."""
    value = content.get(name)
    if type(value) is not bytes or len(value) % (8 * multiple) or (multiple == CAMERA_STATE and not value):
        seen = counted(len(value), "byte") if type(value) is bytes else "missing or not a bin"
        raise BadMessage(name, seen, f"a bin of <f8, a multiple of {8 * multiple} bytes")
    return np.ndarray((len(value) // 8,), F8, value)


def _part(content: Map, name: str, height: int, width: int | None) -> F64 | None:
    """An array that may be absent: `height` rows, of `width` numbers if that is known; flat where height is 0."""
    if content.get(name) is None:
        return None
    if width is not None:
        return fields.rows(lambda: "shard_done", content, name, height, width)
    return _array(content, name, height or 1).reshape((height, -1) if height else -1)


def _camera(content: Map) -> Camera:
    return Camera(
        fields.text("camera", content, "model"),
        tuple(_array(content, "numbers", 1).tolist()),
        fields.integer("camera", content, "width", default=0),
        fields.integer("camera", content, "height", default=0),
    )


def _segment(content: Map) -> Segment | None:
    found = fields.mapping("", content, "segment")
    if not found:
        return None
    process, descriptor, size, offset = (
        fields.integer("segment", found, name) for name in ("process", "descriptor", "size", "offset")
    )
    return Segment(process, descriptor, fields.text("segment", found, "nonce"), size, offset)
