"""A filter that looks on a simulated world, held against the truth: where the camera was, how far the points were."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from factorbus.cli.demo.ekf import CAMERA, FEATURE, Filter
from factorbus.cli.demo.visual import Tracked, VisualFilter, VisualSettings
from factorbus.client import Features
from factorbus.proto.arrays import F64
from factorbus.simulate import Frame, MonocularWorld

_START_VELOCITY, _START_TURN = 0.05, 0.02  # how well the first velocities are known, m/s and rad/s
_TARGET_POINTS, _TARGET_SHARE = 6, 0.01  # points of a known target, and how well their distances are known
_3_SIGMA = 14.16  # of three standard normal numbers squared, as rare as 3σ of one
_LONG_ENOUGH = 10  # pixels of a feature that is judged


@dataclass(slots=True)
class DepthHistory:
    """How well a feature's depth was known: σ_ρ/ρ frame by frame, and its last error in standard deviations."""

    rho_true: float
    share: list[float] = field(default_factory=list)
    error: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class SeenFeature:
    """One frame, judged.  rays (n, 6): y of the features; spread (n,): their σ_ρ."""

    number: int
    position: F64
    error_m: float
    nees: float
    rays: F64
    spread: F64
    grow_ms: float
    filter_ms: float


class FilterEvaluator:
    """Drives a filter through a world."""

    def __init__(self, world: MonocularWorld, front: Features, most: int) -> None:
        self._world = world
        settings = VisualSettings(world.sigma_pixel, most=most)
        self.visual = VisualFilter(front, settings, Filter(np.zeros(CAMERA), np.zeros((CAMERA, CAMERA))))
        self._histories: dict[Tracked, DepthHistory] = {}
        self.ended: list[tuple[Tracked, DepthHistory]] = []

    def run(self) -> Iterator[SeenFeature]:
        """All frames.  Raises Unavailable, Refused."""
        for number, frame in enumerate(self._world):
            started = time.perf_counter()
            if number == 0:
                self._start(frame)
            lost = self.visual.look(number, 1 / self._world.rate_hz if number else 0.0, frame.points, frame.pixels)
            self.ended += [(feature, self._histories[feature]) for feature in lost]
            between = time.perf_counter()
            self._grow(number, frame)
            yield self._judged(number, frame, (between - started) * 1e3, (time.perf_counter() - between) * 1e3)
        self.ended += [(feature, self._histories[feature]) for feature in self.visual.tracked]

    def _start(self, frame: Frame) -> None:
        """At the origin, which is the world's; velocities as somebody else measured them."""
        rng = np.random.default_rng([self._world.seed, 3])
        velocity = rng.normal(size=3) * _START_VELOCITY + frame.velocity[:3]
        turn = rng.normal(size=3) * _START_TURN + frame.velocity[3:]
        x = np.concatenate([frame.pose[:3], frame.pose[[6, 3, 4, 5]], velocity, turn])
        sigmas = np.array([1e-6] * 7 + [_START_VELOCITY] * 3 + [_START_TURN] * 3)
        self.visual.filter = Filter(x, np.diag(sigmas**2))

    def _grow(self, number: int, frame: Frame) -> None:
        order = np.arange(len(frame.points))
        if number == 0:  # the points of the target are first, and recognized without fail
            order = np.argsort(frame.outlier, kind="stable")
        for feature in self.visual.grow(number, frame.points, frame.pixels, order.tolist()):
            distance = float(np.linalg.norm(self._world.points[feature.track] - frame.pose[:3]))
            self._histories[feature] = DepthHistory(1 / distance)
        if number == 0:
            self._measure_target()

    def _measure_target(self) -> None:
        """A target in view when it starts gives the scale, as in MonoSLAM: the distances to some points are known."""
        filter, count = self.visual.filter, min(_TARGET_POINTS, len(self.visual.tracked))
        truth = np.array([self._histories[feature].rho_true for feature in self.visual.tracked[:count]])
        H = np.zeros((count, len(filter.x)))
        H[np.arange(count), CAMERA + FEATURE * np.arange(count) + 5] = 1.0
        filter.update(truth - filter.features[:count, 5], H, np.diag((_TARGET_SHARE * truth) ** 2))

    def _judged(self, number: int, frame: Frame, filter_ms: float, grow_ms: float) -> SeenFeature:
        filter, count = self.visual.filter, len(self.visual.tracked)
        spread = np.sqrt(np.array([filter.feature_covariance(i)[5, 5] for i in range(count)]))
        for feature, rho, sigma in zip(self.visual.tracked, filter.features[:, 5], spread, strict=True):
            history = self._histories[feature]
            history.share.append(float(sigma / abs(rho)))
            history.error = float((rho - history.rho_true) / sigma)
        off = filter.x[:3] - frame.pose[:3]
        nees = float(off @ np.linalg.solve(filter.P[:3, :3] + 1e-18 * np.eye(3), off))
        position = filter.x[:3].copy()
        return SeenFeature(
            number, position, float(np.linalg.norm(off)), nees, filter.features.copy(), spread, grow_ms, filter_ms
        )


def verdict(frames: list[SeenFeature], evaluator: FilterEvaluator) -> dict[str, Any]:
    """What the run comes to: errors, consistency, how rays became points."""
    lasting = [history for feature, history in evaluator.ended if feature.matched >= _LONG_ENOUGH]
    errors = np.abs([history.error for history in lasting])
    nees = np.array([frame.nees for frame in frames[1:]])
    counts = evaluator.visual.counts
    return {
        "frames": len(frames),
        "features": counts["features"],
        "features_judged": len(lasting),
        "dropped_as_wrong": counts["wrong"],
        "pixels_used": counts["matched"],
        "error_m": {"rms": float(np.sqrt(np.mean([f.error_m**2 for f in frames]))), "end": frames[-1].error_m},
        "way_m": float(sum(np.linalg.norm(b.position - a.position) for a, b in pairwise(frames))),
        "nees": {"mean": float(nees.mean()), "wanted": 3.0, "within_3_sigma": float((nees < _3_SIGMA).mean())},
        "inverse_depth_within_3_sigma": float((errors < 3).mean()) if lasting else None,
        "relative_depth": {
            "first": float(np.median([history.share[0] for history in lasting])) if lasting else None,
            "last": float(np.median([history.share[-1] for history in lasting])) if lasting else None,
        },
        "filter_ms": float(np.median([f.filter_ms for f in frames])),
        "grow_ms": float(np.median([f.grow_ms for f in frames if f.grow_ms > 0.05] or [0.0])),
        "made_by": dict(evaluator.visual.workers),
    }
