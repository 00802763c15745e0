"""Write the golden messages of inverse-depth features, as `../make.py` does for the others.

    python proto/vectors/features/make.py [FOLDER]        (default: the folder of this file)

Answers are what workers compute (`workers/MATH.md`): `answer` answers `ask`, and each `shard_done_…` a
shard of the question in its form, the same on every machine but for the last bits of arc tangents.
"""

import json
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from factorbus.idp import job
from factorbus.proto import codec
from factorbus.proto import features_codec as features
from factorbus.proto.camera import Camera
from factorbus.proto.features import Ask, Observations, Segment, Shard, ShardDone
from factorbus.proto.messages import Job, JobDone

_NUMBERS = (
    "numbers", "state", "covariance", "pixels", "y", "rows", "cross", "blocks", "turn", "own", "U", "S",
)  # fmt: skip


def main() -> None:
    """Write all vectors."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for name, data in vectors().items():
        (folder / f"{name}.msgpack").write_bytes(data)
        (folder / f"{name}.json").write_text(described(data))


def vectors() -> dict[str, bytes]:
    """The golden messages by name: two pixels, a filter that has nothing but its camera."""
    ask = features.encode_ask(Ask(_observations(), "half"))
    rows = features.encode_ask(Ask(_observations(), "rows"))
    factored = features.encode_ask(Ask(_observations(_RADTAN), "factored"))
    shard = _done(ask, 0, 2)
    segment = Segment(4711, 12, "1e" * 16, 8192, 4096)
    return {
        "ask": rows,
        "ask_half": ask,
        "ask_into_segment": features.encode_ask(Ask(_observations(), "rows", segment)),
        "ask_radtan": factored,
        "shard": features.encode_shard(Shard(ask, 0, 2)),
        "shard_done_rows": _done(rows, 0, 1),
        "shard_done_half": shard,
        "shard_done_factored": _done(factored, 1, 2),
        "shard_done_stored": _stored(shard),
        "job_idp": codec.encode_job(Job("j2", "idp", features.encode_shard(Shard(ask, 0, 2)))),
        "job_done_idp": codec.encode_job_done(JobDone("j2", "idp", shard, 0.25)),
        "answer": features.encode_answer([(_done(rows, 0, 2), "w1", 0.25)], clean=True),
    }


def described(data: bytes) -> str:
    """The .json of a message."""
    return json.dumps(_plain(msgpack.unpackb(data)), indent=1, ensure_ascii=False) + "\n"


_RADIAL = Camera("radial", (2.0, 0.0125, 0.0125, 160.0, 120.0, 0.0625, 0.015625), 320, 240)
_RADTAN = Camera("radtan", (458.0, 457.0, 367.0, 248.0, -0.25, 0.0625, 0.0, 0.0))


def _observations(camera: Camera = _RADIAL) -> Observations:
    state = np.array([0.0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    pixels = np.array([[100.5, 60.25], [200.0, 150.0]])
    return Observations(camera, state, np.eye(13) / 64, pixels, 0.5, 0.25, 1.0)


def _done(ask: bytes, first: int, last: int) -> bytes:
    return job.do(features.encode_shard(Shard(ask, first, last)))


def _stored(shard: bytes) -> bytes:
    """The same features, with the rows in shared memory."""
    done = features.decode_shard_done(shard)
    return features.encode_shard_done(ShardDone(done.first, done.last, done.y, stored=True))


def _plain(content: Any, name: str = "") -> Any:
    if isinstance(content, dict):
        return {key: _plain(value, key) for key, value in content.items()}
    if isinstance(content, list):
        return [_plain(item) for item in content]
    if isinstance(content, bytes):
        if name not in _NUMBERS:
            return {"msgpack": _plain(msgpack.unpackb(content))}
        return {"f64": np.frombuffer(content, "<f8").tolist()}
    return content


if __name__ == "__main__":
    main()
