"""The steps that a map has made, as ask/history answers: for the plots of who comes late.  Both ways, as bytes.

The reader raises BadMessage, TooLarge.
"""

from dataclasses import dataclass

import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import F64, I64
from factorbus.proto.codec import encode_map
from factorbus.proto.fields import F8, I8, Map
from factorbus.proto.limits import ANSWER_LIMITS, MessageLimits
from factorbus.proto.problems import BadMessage
from factorbus.wording import counted

_INTEGERS, _NUMBERS = ("eliminated", "changed"), ("chi2", "step_ms")


@dataclass(frozen=True, slots=True)
class StepHistory:
    """Steps, oldest first: to which revision each led (n,), ascending, and what its report said (n,).

    chi2: χ² after it; step_ms: of the solver; eliminated: variables, each time counted; changed: variables.
    """

    epoch: int
    revision: int
    revisions: I64
    chi2: F64
    step_ms: F64
    eliminated: I64
    changed: I64


def encode_step_history(history: StepHistory) -> bytes:
    """The bytes of the answer."""
    return encode_map(
        {
            "epoch": history.epoch,
            "revision": history.revision,
            "revisions": np.asarray(history.revisions, I8).tobytes(),
            **{name: np.asarray(getattr(history, name), F8).tobytes() for name in _NUMBERS},
            **{name: np.asarray(getattr(history, name), I8).tobytes() for name in _INTEGERS},
        }
    )


def decode_step_history(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> StepHistory:
    """The answer that `data` is."""
    content = fields.read_map("history", data, limits)
    size = len(fields.binary("", content, "revisions"))
    if size % 8:
        raise BadMessage("revisions", counted(size, "byte"), "a multiple of 8")
    revisions = _whole_numbers(content, "revisions", size)
    if (revisions[1:] <= revisions[:-1]).any():
        raise BadMessage("revisions", "some out of order", "ascending ones")
    return StepHistory(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        revisions=revisions,
        chi2=fields.rows(lambda: "", content, "chi2", size // 8, 1).reshape(-1),
        step_ms=fields.rows(lambda: "", content, "step_ms", size // 8, 1).reshape(-1),
        eliminated=_whole_numbers(content, "eliminated", size),
        changed=_whole_numbers(content, "changed", size),
    )


def _whole_numbers(content: Map, name: str, size: int) -> I64:
    value = fields.binary("", content, name)
    if len(value) != size:
        raise BadMessage(name, counted(len(value), "byte"), str(size))
    return np.ndarray((size // 8,), I8, value)
