"""What computing features takes on this machine, measured: a few milliseconds when the service starts."""

import time
from collections.abc import Callable

import numpy as np

from factorbus.proto.camera import Camera
from factorbus.proto.features import CAMERA_STATE, Ask, Observations, Shard, answer_size, new_rows_size
from factorbus.proto.features_codec import encode_ask, encode_shard
from factorbus.proto.segments import PAGE, Memory
from factorbus.service.jobs.sharding import Rates

_FEW, _MANY, _WIDE = 1, 1000, 120
_TIMES = 3


def measured() -> Rates:
    """The rates of this machine, at their best of a few times."""
    from factorbus.idp import job

    def takes(payload: bytes) -> float:
        return min(_timed(lambda: job.do(payload)) for _ in range(_TIMES))

    few, many, wide = (example("factored", n) for n in (_FEW, _MANY, _WIDE))
    half = encode_ask(wide._replace(form="half"))
    fixed_s = takes(_whole(encode_ask(few), _FEW))
    feature_s = max(0.0, takes(_whole(encode_ask(many), _MANY)) - fixed_s) / _MANY
    rest = fixed_s + feature_s * _WIDE
    number_s = max(0.0, takes(_whole(half, _WIDE)) - rest) / (answer_size(wide._replace(form="half")) / 8)
    stored_s = max(0.0, _stored(job.do, wide) - rest) / (new_rows_size(_WIDE, CAMERA_STATE) / 8)
    return Rates(fixed_s, feature_s, number_s, stored_s or number_s)


def example(form: str, n: int) -> Ask:
    """A question of `n` features by a filter that knows its camera only."""
    state = np.zeros(CAMERA_STATE)
    state[3] = 1.0
    pixels = np.stack([np.linspace(50.0, 590.0, n), np.linspace(400.0, 60.0, n)], axis=1)
    camera = Camera("radtan", (500.0, 500.0, 320.0, 240.0, -0.1, 0.01, 0.0, 0.0), 640, 480)
    return Ask(Observations(camera, state, 1e-4 * np.eye(CAMERA_STATE), pixels), form)


def _stored(do: Callable[[bytes], bytes], ask: Ask) -> float:
    """Seconds of an answer through fresh shared memory; 0 where there is none."""
    n, best = ask.observations.count, 0.0
    for _ in range(_TIMES):
        try:
            memory = Memory(PAGE + new_rows_size(n, CAMERA_STATE))
        except OSError:
            return 0.0
        with memory:
            payload = _whole(encode_ask(Ask(ask.observations, "rows", memory.segment(PAGE))), n)
            took = _timed(lambda payload=payload: do(payload))
        best = min(best or took, took)
    return best


def _whole(ask: bytes, n: int) -> bytes:
    return encode_shard(Shard(ask, 0, n))


def _timed(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started
