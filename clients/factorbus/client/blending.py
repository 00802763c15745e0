"""Corrections of a pose, each blended over a time instead of made at once.  Pure: the time is handed in.

A correction at t₀ leaves the pose g where it is and leads it to the new one, x, along the geodesic at constant speed:

    g(t) = g(t₀) ∘ exp(u log(g(t₀)⁻¹ ∘ x)),   u = (t − t₀) / τ, at most 1

τ is `smooth_s`.  Where a blend was under way, with the length r of its way and the time τᵣ left, and the new correction
is of length c, τ = (r τᵣ + c smooth_s) / (r + c).  So what is left of a large correction comes in its time, also while
small ones follow each other faster than that.  The pose moves about as fast as by both blends at once, at most.

Why constant speed, why the geodesic: docs/decisions/blended-corrections.md.
"""

import math

import numpy as np

from factorbus.client.geodesic import along_geodesic, length_of_way
from factorbus.proto.arrays import F64


class PoseBlend:
    """One pose, (3,) or (7,), as it is given; `raw` is as it is."""

    def __init__(self, pose: F64, smooth_s: float) -> None:
        self.raw, self.smooth_s = pose.copy(), smooth_s
        self._start, self._began_s, self._span_s = self.raw, -math.inf, 0.0

    def correct(self, pose: F64, now_s: float) -> None:
        """From now on the way leads to `pose`.  One that is the same corrects nothing."""
        if np.array_equal(pose, self.raw):
            return
        given, left_s = self.at(now_s), self.left_s(now_s)
        rest, more = length_of_way(given, self.raw), length_of_way(self.raw, pose)
        whole = rest + more
        span_s = (rest * left_s + more * self.smooth_s) / whole if whole > 0.0 else 0.0
        self.raw, self._start, self._began_s, self._span_s = pose.copy(), given, now_s, span_s

    def at(self, now_s: float) -> F64:
        """The pose to give now: a copy, and exactly `raw` once the time has passed."""
        passed_s = now_s - self._began_s
        if passed_s >= self._span_s:
            return self.raw.copy()
        if passed_s <= 0.0:
            return self._start.copy()
        return along_geodesic(self._start, self.raw, passed_s / self._span_s)

    def left_s(self, now_s: float) -> float:
        """Until it is `raw`, seconds; 0 where it is."""
        return min(max(self._span_s - (now_s - self._began_s), 0.0), self._span_s)
