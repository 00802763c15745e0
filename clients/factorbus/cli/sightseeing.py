"""A filter that looks on a simulated world: features come from the bus, pixels sharpen them, and all of it is judged.

for frame in world:
    1  predict                       constant velocity
    2  match                         pixels of known points against their prediction, gated
    3  update
    4  drop                          what is lost, or was never right
    5  grow                          new features, made by the service and its workers
"""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from factorbus.cli.ekf import CAMERA, FEATURE, Filter
from factorbus.client import Features
from factorbus.idp.predict import predict
from factorbus.proto.arrays import F64
from factorbus.simulate import Frame, MonocularWorld

# 99 % of two standard normal numbers squared.
_GATE = 9.21
# A linear filter believes its pixels too much: with this its NEES is 2.6 over eight seeds, without 3.9, of 3 wanted.
_PRUDENCE = 1.2
_SIGMA_VELOCITY, _SIGMA_TURN = 0.05, 0.02  # m/s and rad/s a frame, some more than the camera's accelerations
_START_VELOCITY, _START_TURN = 0.05, 0.02  # how well the first velocities are known
_TARGET_POINTS, _TARGET_SHARE = 6, 0.01  # points of a known target, and how well their distances are known
_LOST_FRAMES, _WRONG_SHARE, _JUDGED_AFTER = 20, 0.4, 5


@dataclass(slots=True)
class Tracked:
    """A feature of the filter, and what became of it."""

    point: int
    born: int
    rho_true: float
    seen_at: int
    matched: int = 0
    rejected: int = 0
    sigma: list[float] = field(default_factory=list)  # σ_ρ/ρ, frame by frame
    error: float = 0.0  # of ρ, in its standard deviations, when it was last updated


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One frame, judged.  rays (n, 6): y of the features; spread (n,): their σ_ρ."""

    number: int
    position: F64
    sigma: F64
    error_m: float
    nees: float
    rays: F64
    spread: F64
    grow_ms: float
    filter_ms: float


class Sightseer:
    """Drives a filter through a world."""

    def __init__(self, world: MonocularWorld, front: Features, most: int) -> None:
        self._world, self._front, self._most = world, front, most
        self._tracked: list[Tracked] = []
        self.ended: list[Tracked] = []
        self.workers: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self._filter = Filter(np.zeros(CAMERA), np.zeros((CAMERA, CAMERA)))

    def run(self) -> Iterator[Seen]:
        """All frames.  Raises Unavailable, Refused."""
        for number, frame in enumerate(self._world):
            started = time.perf_counter()
            if number == 0:
                self._start(frame)
            else:
                self._filter.predict(1 / self._world.rate_hz, _SIGMA_VELOCITY, _SIGMA_TURN)
            self._update(number, frame)
            self._drop(number)
            between = time.perf_counter()
            self._grow(number, frame)
            if number == 0:
                self._measure_distances()
            now = time.perf_counter()
            yield self._judged(number, frame, (between - started) * 1e3, (now - between) * 1e3)
        self.ended += self._tracked

    def _start(self, frame: Frame) -> None:
        """At the origin, which is the world's; velocities as somebody else measured them."""
        rng = np.random.default_rng([self._world.seed, 3])
        velocity = rng.normal(size=3) * _START_VELOCITY + frame.velocity[:3]
        turn = rng.normal(size=3) * _START_TURN + frame.velocity[3:]
        x = np.concatenate([frame.pose[:3], frame.pose[[6, 3, 4, 5]], velocity, turn])
        sigmas = np.array([1e-6] * 7 + [_START_VELOCITY] * 3 + [_START_TURN] * 3)
        self._filter = Filter(x, np.diag(sigmas**2))

    def _update(self, number: int, frame: Frame) -> None:
        if not self._tracked:
            return
        x, P, sigma = self._filter.x, self._filter.P, _PRUDENCE * self._world.sigma_pixel
        predicted = predict(self._world.camera, x[:CAMERA], self._filter.features)
        pixels = dict(zip(frame.points.tolist(), frame.pixels, strict=True))
        rows, innovations = [], []
        for i, feature in enumerate(self._tracked):
            seen = pixels.get(feature.point)
            if seen is None or predicted.status[i]:
                continue
            feature.seen_at = number
            H = np.zeros((2, len(x)))
            H[:, :CAMERA], at = predicted.by_state[i], CAMERA + FEATURE * i
            H[:, at : at + FEATURE] = predicted.by_feature[i]
            nu = seen - predicted.pixels[i]
            S = H @ P @ H.T + sigma**2 * np.eye(2)
            if nu @ np.linalg.solve(S, nu) > _GATE:
                feature.rejected += 1
                continue
            feature.matched += 1
            rows.append(H)
            innovations.append(nu)
        self.counts["matched"] += len(rows)
        if rows:
            self._filter.update(np.concatenate(innovations), np.concatenate(rows), sigma**2 * np.eye(2 * len(rows)))

    def _drop(self, number: int) -> None:
        kept = []
        for i, feature in enumerate(self._tracked):
            looked = feature.matched + feature.rejected
            wrong = looked >= _JUDGED_AFTER and feature.rejected > _WRONG_SHARE * looked
            lost = number - feature.seen_at > _LOST_FRAMES
            if wrong:
                self.counts["wrong"] += 1
            elif lost or self._filter.features[i, 5] <= 0:
                self.ended.append(feature)
            else:
                kept.append(i)
        if len(kept) < len(self._tracked):
            self._filter.drop(kept)
            self._tracked = [self._tracked[i] for i in kept]

    def _grow(self, number: int, frame: Frame) -> None:
        """New features where there is room, of points that are not features yet."""
        known = {feature.point for feature in self._tracked}
        fresh = [k for k, point in enumerate(frame.points.tolist()) if point not in known]
        if number == 0:  # the points of the target are first, and recognised without fail
            fresh.sort(key=lambda k: bool(frame.outlier[k]))
        fresh = fresh[: self._most - len(self._tracked)]
        if not fresh:
            return
        grown = self._front.grow(self._filter.x, self._filter.P, frame.pixels[fresh])
        self._filter = Filter(grown.x, grown.P)
        self.workers.update(grown.workers)
        self.counts["features"] += len(fresh)
        for k in fresh:
            point = int(frame.points[k])
            distance = float(np.linalg.norm(self._world.points[point] - frame.pose[:3]))
            self._tracked.append(Tracked(point, number, 1 / distance, number))

    def _measure_distances(self) -> None:
        """A target in view when it starts gives the scale, as in MonoSLAM: the distances to some points are known."""
        count = min(_TARGET_POINTS, len(self._tracked))
        H, innovation = np.zeros((count, len(self._filter.x))), np.empty(count)
        truth = np.array([feature.rho_true for feature in self._tracked[:count]])
        for i in range(count):
            H[i, CAMERA + FEATURE * i + 5] = 1.0
            innovation[i] = truth[i] - self._filter.x[CAMERA + FEATURE * i + 5]
        self._filter.update(innovation, H, np.diag((_TARGET_SHARE * truth) ** 2))

    def _judged(self, number: int, frame: Frame, filter_ms: float, grow_ms: float) -> Seen:
        x, P = self._filter.x, self._filter.P
        for i, feature in enumerate(self._tracked):
            rho, sigma = x[CAMERA + FEATURE * i + 5], np.sqrt(self._filter.feature_covariance(i)[5, 5])
            feature.sigma.append(float(sigma / abs(rho)))
            feature.error = float((rho - feature.rho_true) / sigma)
        off = x[:3] - frame.pose[:3]
        spread = np.sqrt(np.array([self._filter.feature_covariance(i)[5, 5] for i in range(len(self._tracked))]))
        return Seen(
            number,
            x[:3].copy(),
            np.sqrt(np.diag(P)[:3]),
            float(np.linalg.norm(off)),
            float(off @ np.linalg.solve(P[:3, :3] + 1e-18 * np.eye(3), off)),
            self._filter.features.copy(),
            spread,
            grow_ms,
            filter_ms,
        )


def verdict(frames: list[Seen], sightseer: Sightseer) -> dict[str, Any]:
    """What the run comes to: errors, consistency, how rays became points."""
    lasting = [f for f in sightseer.ended if f.matched >= 10]
    errors = np.array([f.error for f in lasting])
    nees = np.array([frame.nees for frame in frames[1:]])
    shrunk = [(f.sigma[0], f.sigma[-1]) for f in lasting]
    return {
        "frames": len(frames),
        "features": sightseer.counts["features"],
        "features_judged": len(lasting),
        "dropped_as_wrong": sightseer.counts["wrong"],
        "pixels_used": sightseer.counts["matched"],
        "error_m": {"rms": float(np.sqrt(np.mean([f.error_m**2 for f in frames]))), "end": frames[-1].error_m},
        "way_m": float(sum(np.linalg.norm(b.position - a.position) for a, b in pairwise(frames))),
        "nees": {"mean": float(nees.mean()), "wanted": 3.0, "within_3_sigma": float((nees < 14.16).mean())},
        "inverse_depth_within_3_sigma": float((np.abs(errors) < 3).mean()) if len(errors) else None,
        "relative_depth": {
            "first": float(np.median([first for first, _ in shrunk])) if shrunk else None,
            "last": float(np.median([last for _, last in shrunk])) if shrunk else None,
        },
        "filter_ms": float(np.median([f.filter_ms for f in frames])),
        "grow_ms": float(np.median([f.grow_ms for f in frames if f.grow_ms > 0.05] or [0.0])),
        "made_by": dict(sightseer.workers),
    }
