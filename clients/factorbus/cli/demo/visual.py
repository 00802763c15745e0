"""A monocular filter at work on frames of known tracks: predict, match, update, drop, grow.

1  predict      constant velocity
2  match        pixels of known tracks against their prediction, gated
3  update
4  drop         what is lost, or was never right
5  grow         new features, made by the service and its workers
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.cli.demo.ekf import CAMERA, FEATURE, Filter
from factorbus.client import Features
from factorbus.idp.predict import predict
from factorbus.proto.arrays import F64, I64

# 99 % of two standard normal numbers squared.
_GATE = 9.21
# A linear filter believes its pixels too much: with this its NEES is 2.6 over eight seeds, without 3.9, of 3 wanted.
_PRUDENCE = 1.2
_LOST_FRAMES, _WRONG_SHARE, _JUDGED_AFTER = 20, 0.4, 5


@dataclass(frozen=True, slots=True)
class VisualSettings:
    """sigma_pixel: noise of u and of v.  velocity (m/s), turn (rad/s): impulses of the camera's motion in a frame, as
    standard deviations.  most: features in the filter at a time."""

    sigma_pixel: float = 1.0
    velocity: float = 0.05
    turn: float = 0.02
    most: int = 60


@dataclass(slots=True, eq=False)
class Tracked:
    """A feature of the filter: its track, the frames in which it was born and last seen, and how its pixels fared."""

    track: int
    born: int
    seen_at: int
    matched: int = 0
    rejected: int = 0


class VisualFilter:
    """A filter and its features, which come from `front`."""

    def __init__(self, front: Features, settings: VisualSettings, start: Filter) -> None:
        self._front, self._settings = front, settings
        self.filter = start
        self.tracked: list[Tracked] = []
        self.counts: Counter[str] = Counter()  # features, matched, rejected, wrong
        self.workers: Counter[str] = Counter()

    def look(self, number: int, dt_s: float, tracks: I64, pixels: F64) -> list[Tracked]:
        """Steps 1 to 4 of a frame, dt_s after the one before (0: the first); gives what was dropped for being lost.

        in   tracks (k,): whose pixels (k, 2), distorted, u v
        """
        if dt_s:
            self.filter.predict(dt_s, self._settings.velocity, self._settings.turn)
        if self.tracked:
            self._update(number, dict(zip(tracks.tolist(), pixels, strict=True)))
        return self._drop(number)

    def grow(self, number: int, tracks: I64, pixels: F64, order: Sequence[int]) -> list[Tracked]:
        """Step 5: new features of tracks that have none, as far as there is room, in this order; gives them.

        Raises Unavailable, Refused.
        """
        known = {feature.track for feature in self.tracked}
        fresh = [k for k in order if int(tracks[k]) not in known][: self._settings.most - len(self.tracked)]
        if not fresh:
            return []
        grown = self._front.grow(self.filter.x, self.filter.P, pixels[fresh])
        self.filter = Filter(grown.x, grown.P)
        self.workers.update(grown.workers)
        self.counts["features"] += len(fresh)
        new = [Tracked(int(tracks[k]), number, number) for k in fresh]
        self.tracked += new
        return new

    def _update(self, number: int, pixels: dict[int, F64]) -> None:
        x, P = self.filter.x, self.filter.P
        R = (_PRUDENCE * self._settings.sigma_pixel) ** 2 * np.eye(2)
        predicted = predict(self._front.camera, x[:CAMERA], self.filter.features)
        rows, innovations = [], []
        for i, feature in enumerate(self.tracked):
            seen = pixels.get(feature.track)
            if seen is None or predicted.status[i]:
                continue
            feature.seen_at = number
            H, at = np.zeros((2, len(x))), CAMERA + FEATURE * i
            H[:, :CAMERA], H[:, at : at + FEATURE] = predicted.by_state[i], predicted.by_feature[i]
            off = seen - predicted.pixels[i]
            if off @ np.linalg.solve(H @ P @ H.T + R, off) > _GATE:
                feature.rejected += 1
                continue
            feature.matched += 1
            rows.append(H)
            innovations.append(off)
        self.counts["matched"] += len(rows)
        if rows:
            self.filter.update(np.concatenate(innovations), np.concatenate(rows), R[0, 0] * np.eye(2 * len(rows)))

    def _drop(self, number: int) -> list[Tracked]:
        kept, lost = [], []
        for i, feature in enumerate(self.tracked):
            looked = feature.matched + feature.rejected
            if looked >= _JUDGED_AFTER and feature.rejected > _WRONG_SHARE * looked:
                self.counts["wrong"] += 1
            elif number - feature.seen_at > _LOST_FRAMES or self.filter.features[i, 5] <= 0:
                lost.append(feature)
            else:
                kept.append(i)
        if len(kept) < len(self.tracked):
            self.filter.drop(kept)
            self.tracked = [self.tracked[i] for i in kept]
        return lost
