"""Which InsertBatch is short: most likely done sooner than another thread would have taken it over.

It is for one insert of at most _SHORT_BYTES, and none of late took longer than SHORT_S, unless the insert was on its
way already when the last one ended: then more likely follow, to be applied together.
"""

import math
from collections.abc import Sequence
from typing import Any

from factorbus.proto.problems import Problem
from factorbus.service.core.events import Arrived

_SHORT_BYTES = 16 << 10
SHORT_S = 0.002
_ROUND_TRIP_S = 0.0002


class ShortBatches:
    """Of one map, by how long its batches took."""

    def __init__(self) -> None:
        self._ended = 0.0
        self._slowest_s = math.inf  # of late: forgotten by a tenth with every InsertBatch

    def ended(self, seconds: float, now: float) -> None:
        """One took so long."""
        self._ended = now
        self._slowest_s = max(seconds, 0.9 * self._slowest_s if self._slowest_s < math.inf else 0.0)

    def is_quick(self, size: int, now: float) -> bool:
        """Whether one insert of this size would be short, by all but its content."""
        return size <= _SHORT_BYTES and self._slowest_s <= SHORT_S and now - self._ended >= _ROUND_TRIP_S

    def is_short(self, reads: Sequence[Any], inserts: Sequence[Arrived], now: float) -> bool:
        """Whether one of these would be."""
        if reads or len(inserts) != 1 or not self.is_quick(inserts[0].size, now):
            return False
        content = inserts[0].content
        if isinstance(content, Problem):
            return True
        return not (inserts[0].is_change or content.convert_below or content.settle)
