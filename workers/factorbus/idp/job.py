"""The job of kind `idp`: a shard of a question's features, the same bits in any process."""

import numpy as np

from factorbus.idp.minimal import FeatureRows, covariance_factors
from factorbus.idp.new_features import Seen, see
from factorbus.proto import segments
from factorbus.proto.features import FEATURE, Ask, Segment, Shard, ShardDone, answer_size, new_rows_size
from factorbus.proto.features_codec import decode_ask, decode_shard, encode_shard_done
from factorbus.proto.limits import ANSWER_LIMITS
from factorbus.proto.problems import BadMessage, TooLarge


def do(payload: bytes) -> bytes:
    """The encoded ShardDone of an encoded Shard.

    Raises BadMessage, TooLarge, BadCamera, BadShape, BadState, BadPixel.
    """
    shard = decode_shard(payload)
    return encode_shard_done(done(shard, decode_ask(shard.ask, ANSWER_LIMITS)))


def done(shard: Shard, ask: Ask) -> ShardDone:
    """`shard` of the question `ask`.  Raises BadMessage, TooLarge, BadShape, BadState, BadPixel."""
    first, last, n = shard.first, shard.last, ask.observations.count
    if last > n:
        raise BadMessage("last", f"is {last}", f"at most {n}, the number of pixels")
    if answer_size(ask) > ANSWER_LIMITS.max_bytes:
        raise TooLarge(
            "the answer", answer_size(ask), ANSWER_LIMITS.max_bytes, "bytes", "ask for fewer features at a time"
        )
    seen = see(ask.observations)
    y = seen.y[first:last]
    if ask.form == "factored":
        found = covariance_factors(ask.observations, seen, first, last)
        return ShardDone(first, last, y, turn=found.turn, own=found.own, U=found.U, S=found.S)
    if ask.form == "half":
        half = FeatureRows(ask.observations, seen, first).half(first, last)
        return ShardDone(first, last, y, cross=half.cross, blocks=half.blocks)
    if ask.segment is not None and _stored(shard, ask, ask.segment, seen):
        return ShardDone(first, last, y, stored=True)
    return ShardDone(first, last, y, rows=_rows(shard, ask, seen))


def _stored(shard: Shard, ask: Ask, segment: Segment, seen: Seen) -> bool:
    """Whether the rows could be written to shared memory."""
    n, m = ask.observations.count, ask.observations.width
    width, rows = m + FEATURE * n, FEATURE * (shard.last - shard.first)
    start = 8 * FEATURE * shard.first * width
    out = segments.try_array(segment, new_rows_size(n, m), start, (rows, width)) if rows else None
    if out is None:
        return False
    FeatureRows(ask.observations, seen).rows(shard.first, shard.last, out)
    return True


def _rows(shard: Shard, ask: Ask, seen: Seen) -> np.ndarray:
    n, m = ask.observations.count, ask.observations.width
    if (size := new_rows_size(n, m)) > ANSWER_LIMITS.max_bytes:
        raise TooLarge(
            "the answer, which cannot go to shared memory,",
            size,
            ANSWER_LIMITS.max_bytes,
            "bytes",
            "ask for fewer features at a time",
        )
    rows = np.empty((FEATURE * (shard.last - shard.first), m + FEATURE * n))
    FeatureRows(ask.observations, seen).rows(shard.first, shard.last, rows)
    return rows
