"""Into how many shards the features of a question go, and whether the way to a worker pays at all.  Pure.

All times are measured: what computing takes here when the service starts, what the way to a worker takes when it joins.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from factorbus.proto.features import FEATURE, Ask, answer_size, new_rows_size


@dataclass(frozen=True, slots=True)
class Rates:
    """What computing takes, in seconds: every time, per feature, per number of the answer, per number stored."""

    fixed_s: float
    feature_s: float
    number_s: float
    stored_s: float


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """What the way to a worker and back takes: every time, per byte that comes back."""

    fixed_s: float
    byte_s: float


@dataclass(frozen=True, slots=True)
class Work:
    """A question in numbers: features, bytes that travel back, numbers to compute, whether they are stored."""

    features: int
    bytes_back: int
    numbers: int
    stored: bool


def work_of(ask: Ask) -> Work:
    """The work that a question is."""
    stored = ask.form == "rows" and ask.segment is not None
    numbers = new_rows_size(ask.observations.count, ask.observations.width) if stored else answer_size(ask)
    return Work(ask.observations.count, answer_size(ask), numbers // 8, stored)


def seconds(work: Work, rates: Rates, shards: int = 1) -> float:
    """What one of `shards` shards takes to compute: each worker looks at all features and makes its share of rows."""
    number_s = rates.stored_s if work.stored else rates.number_s
    return rates.fixed_s + rates.feature_s * work.features + number_s * work.numbers / shards


def shards_for(work: Work, rates: Rates, latencies: Sequence[RoundTrip], slots: int) -> int:
    """How many shards the work goes to workers in; 0: in place, because the way takes longer than the work.

    A shard costs every worker a look at all features, so more of them are not always sooner.
    latencies: of the workers there are.  slots: jobs that they take at a time.
    """
    if not latencies or slots < 1 or work.features < 1:
        return 0
    way = max(trip.fixed_s for trip in latencies) + max(trip.byte_s for trip in latencies) * work.bytes_back
    if way >= seconds(work, rates):
        return 0
    # Those that share a core's time or memory gain nothing, but lose nothing either; the first of equals is taken.
    return min(range(1, min(slots, work.features) + 1), key=lambda count: seconds(work, rates, count))


def cuts(ask: Ask, shards: int) -> list[tuple[int, int]]:
    """(first, last) of each shard: as many rows for each; in the form `half`, as many blocks."""
    n = ask.observations.count
    if ask.form != "half":
        edges = [n * k // shards for k in range(shards + 1)]
    else:
        edges = [0]
        row_bytes = 6 * ask.observations.width
        share = (row_bytes * n + FEATURE * FEATURE * n * (n + 1) // 2) / shards
        done = 0
        for i in range(n):
            done += row_bytes + FEATURE * FEATURE * (n - i)
            if len(edges) < shards and done >= share * len(edges):
                edges.append(i + 1)
        edges.append(n)
    return [(first, last) for first, last in pairwise(edges) if first < last]
