"""A camera among points, estimated in a map with `idp` features through a service, and how honest the map is.

A front end that knows pixels and tracks only: a new camera is placed by steady motion, a feature begins when its track
has gone smoothly for three frames, every later pixel is an observation with a robust loss.  The gauge is the first
pose, the scale a target in view of the first frame whose distances are known, as in MonoSLAM.  Nothing else joins the
poses. At the end the map is held against the truth by the covariances of a dense inverse.
"""

import time
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from bench import idp_bus
from naive.dense_factors import boxplus, pose_matrix, pose_vector
from naive.solver_parts import graph_in, system_in

from factorbus.client import Draft, Map, connect
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import symbol
from factorbus.simulate import Frame, MonocularWorld, monocular
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_converted
from factorbus.solver.kernels.model import layout as at

LOSS = ("dcs", 4.0)
_RHO, _SIGMA_RHO = 0.35, 0.25
_TARGET, _TARGET_SHARE = 8, 0.01
_SMOOTH_PX = 6.0  # how far a track may be from where its last two pixels lead
_FAR_OFF_PX = 40.0  # how far a pixel may be from where the map has its feature
_LASTING = 10  # observations of a feature that is judged
_WITHIN = {1: 9.0, 3: 14.16, 6: 20.06}  # χ² that is as rare as 3σ


class Target(Protocol):
    """A map: somewhere to insert, and what it estimates."""

    def insert(self, batch: Batch | Draft, *, settle: bool = False, convert_below: float = 0.0) -> Any: ...

    def value(self, key: int) -> np.ndarray: ...


@dataclass(slots=True)
class Track:
    """What the front end knows of one track: its last pixels by frame, and its feature once it has one."""

    pixels: dict[int, np.ndarray] = field(default_factory=dict)
    first: int = -1
    observations: int = 0
    outliers: int = 0


class FrontEnd:
    """Tells a map what a camera sees."""

    def __init__(self, world: MonocularWorld, target: Target, convert_below: float = 0.0, every: int = 20) -> None:
        self.world, self._map, self._below, self._every = world, target, convert_below, every
        self.tracks: dict[int, Track] = {}
        self.poses: list[np.ndarray] = []  # true ones
        self._sigma = world.sigma_pixel

    def run(self) -> None:
        """All frames, then until converged."""
        for number, frame in enumerate(self.world):
            draft = Draft()
            if number == 0:
                self._begin(draft, frame)
            else:
                draft.se3(symbol("x", number), self._ahead(number))
                self._observations(draft, number, frame)
            self.poses.append(frame.pose)
            below = self._below if number % self._every == 0 else 0.0
            self._map.insert(draft, convert_below=below)
        self._map.insert(Draft(), settle=True)

    def _begin(self, draft: Draft, frame: Frame) -> None:
        """The first camera is where it is; some points of the target are recognized, and their distances known."""
        draft.se3(symbol("x", 0), frame.pose, fixed=True)
        recognized = np.flatnonzero(~frame.outlier)[:_TARGET]
        for k, (track, pixel) in enumerate(zip(frame.points.tolist(), frame.pixels, strict=True)):
            self.tracks[track] = Track({0: pixel})
            if k in recognized:
                rho = 1 / float(np.linalg.norm(self.world.points[track] - frame.pose[:3]))
                noisy = rho * (1 + _TARGET_SHARE * np.random.default_rng([self.world.seed, track]).normal())
                self._feature(draft, 0, track, pixel, noisy, _TARGET_SHARE * rho)

    def _feature(self, draft: Draft, n: int, track: int, pixel: np.ndarray, rho: float, sigma_rho: float) -> None:
        key = symbol("f", track)
        draft.idp(key)
        draft.idp_first(
            symbol("x", n), key, self.world.camera, pixel, rho, sigma_rho=sigma_rho, sigma_pixel=self._sigma
        )
        self.tracks[track].first, self.tracks[track].observations = n, 1

    def _ahead(self, number: int) -> np.ndarray:
        """Where steady motion leads: the last step once more."""
        last = pose_matrix(self._map.value(symbol("x", number - 1)))
        if number == 1:
            return pose_vector(last)
        before = pose_matrix(self._map.value(symbol("x", number - 2)))
        return pose_vector(last @ np.linalg.inv(before) @ last)

    def _observations(self, draft: Draft, number: int, frame: Frame) -> None:
        for track, pixel in zip(frame.points.tolist(), frame.pixels, strict=True):
            known = self.tracks.setdefault(track, Track())
            known.pixels = {n: p for n, p in known.pixels.items() if n >= number - 2} | {number: pixel}
            sigmas = (self._sigma, self._sigma)
            if known.first >= 0:
                draft.idp_seen(
                    symbol("x", number), symbol("f", track), self.world.camera, pixel, sigmas=sigmas, loss=LOSS
                )
                known.observations += 1
            elif number > 2 and self._is_smooth(known, number):
                self._feature(draft, number, track, pixel, _RHO, _SIGMA_RHO)

    def _is_smooth(self, track: Track, number: int) -> bool:
        """An outlier is anywhere in the image."""
        if len(track.pixels) < 3:
            return False
        before, last, now = (track.pixels[number - k] for k in (2, 1, 0))
        return float(np.linalg.norm(now - 2 * last + before)) < _SMOOTH_PX * self._sigma


class Near:
    """A map in this process."""

    def __init__(self, mode: str = "auto") -> None:
        self.solver, self.reports = Solver(Options(mode=mode)), []
        self._values: dict[int, np.ndarray] = {}

    def insert(self, batch: Batch | Draft, *, settle: bool = False, convert_below: float = 0.0) -> None:
        """As the service does."""
        self.solver.stage(batch.batch() if isinstance(batch, Draft) else batch)
        self.reports.append(self.solver.step(settle=settle))
        if convert_below and (keys := self.solver.convertible(convert_below)).size:
            self.solver, report = with_converted(self.solver, keys)
            self.reports.append(report)
        for group in self.solver.changed():
            self._values.update(zip(group.keys.tolist(), group.values, strict=True))

    def value(self, key: int) -> np.ndarray:
        """The estimate of one variable."""
        return self._values[key]

    def graph(self) -> Batch:
        """Everything."""
        variables, factors = self.solver.graph()
        return Batch(tuple(variables), tuple(factors))  # type: ignore[arg-type]


class Far:
    """A map of a service."""

    def __init__(self, joined: Map) -> None:
        self._map = joined

    def insert(self, batch: Batch | Draft, *, settle: bool = False, convert_below: float = 0.0) -> None:
        """Until the mirror has it."""
        self._map.insert(batch, settle=settle, convert_below=convert_below)

    def value(self, key: int) -> np.ndarray:
        """The estimate of one variable."""
        return self._map.estimate[key]

    def graph(self) -> Batch:
        """Everything."""
        return self._map.graph().batch


def measure(frames: int = 200, seed: int = 4) -> list[dict[str, Any]]:
    """Through a service: features that stay features, and features that become points."""
    found = []
    with (
        idp_bus.process("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm") as endpoint,
        connect(endpoint, client="bench", timeout_s=600) as bus,
    ):
        for name, below in (("features", 0.0), ("points", 0.1)):
            with bus.map(name) as joined:
                far = Far(joined)
                front = FrontEnd(monocular(frames, seed), far, below)
                started = time.perf_counter()
                front.run()
                seconds = time.perf_counter() - started
                found.append({"map": name, "seconds": seconds, "seed": seed} | judged(front, far.graph()))
    return found


def report(rows: list[dict[str, Any]]) -> str:
    """Tables for a person."""
    lines = ["A camera among points in a map, by pixels alone; held against the truth by the dense inverse", ""]
    for row in rows:
        position, pose, depth = row["nees_position"], row["nees_pose"], row["inverse_depth"]
        lines += [
            f"  {row['map']}: {row['frames']} frames, {row['features']} features ({row['points']} points at the end), "
            f"{row['observations']} observations, {row['inactive']} inactive, {row['seconds']:.0f} s",
            f"    position {row['error_m']['rms'] * 1e3:.1f} mm RMS; NEES {position['mean']:.2f} of 3, "
            f"{position['within']:.1%} within 3σ; of the pose {pose['mean']:.2f} of 6, {pose['within']:.1%}",
            f"    inverse depths: NEES {depth['nees']:.2f} of 1, {depth['within']:.1%} of {row['features_judged']} "
            f"within 3σ, σ/ρ {row['relative_depth']:.2%} in the median",
        ]
    return "\n".join(lines)


def judged(front: FrontEnd, graph: Batch) -> dict[str, Any]:
    """How far the map is from the truth, in metres and in its own standard deviations."""
    solver = Solver(Options(mode="all-batch", max_iterations=0))
    solver.stage(graph)
    covariance, starts, values = _covariance(solver)
    poses = _poses(front, covariance, starts, values)
    depths = _depths(front, covariance, starts, values)
    off, nees3, nees6 = (np.array(column) for column in zip(*poses, strict=True))
    errors = np.array([error for _, error in depths])
    shares = np.array([share for share, _ in depths])
    observations = [t.observations for t in front.tracks.values() if t.first >= 0]
    return {
        "frames": len(front.poses),
        "features": len(observations),
        "points": sum(len(group.keys) for group in graph.variables if group.kind == "point3"),
        "features_judged": len(depths),
        "observations": sum(observations),
        "inactive": len(solver.inactive()),
        "error_m": {"rms": float(np.sqrt(np.mean(off**2))), "end": float(off[-1])},
        "nees_position": {"mean": float(nees3.mean()), "wanted": 3.0, "within": float((nees3 < _WITHIN[3]).mean())},
        "nees_pose": {"mean": float(nees6.mean()), "wanted": 6.0, "within": float((nees6 < _WITHIN[6]).mean())},
        "inverse_depth": {"nees": float(np.mean(errors**2)), "within": float((errors**2 < _WITHIN[1]).mean())},
        "relative_depth": float(np.median(shares)),
    }


def _covariance(solver: Solver) -> tuple[np.ndarray, dict[int, int], dict[int, np.ndarray]]:
    """Λ⁻¹, dense; first scalars and values by key."""
    solver.step()
    graph, blocks = graph_in(solver), system_in(solver).blocks
    n = int(graph.counts[at.SCALARS])
    offsets = np.concatenate([[0], np.cumsum(graph.dims[: graph.counts[at.COLUMNS]])])
    information = np.zeros((n, n))
    for row, column, start in zip(blocks.rows, blocks.cols, blocks.offsets, strict=True):
        a, b = graph.dims[row], graph.dims[column]
        block = blocks.data[start : start + a * b].reshape(a, b)
        information[offsets[row] : offsets[row] + a, offsets[column] : offsets[column] + b] = block
        information[offsets[column] : offsets[column] + b, offsets[row] : offsets[row] + a] = block.T
    scale = 1 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * scale * scale[:, None]) * scale * scale[:, None]
    keys = graph.keys[: graph.counts[at.VARIABLES]].tolist()
    scalars = graph.var[: len(keys), at.V_SCALAR].tolist()
    values = {key: v for group in solver.estimate() for key, v in zip(group.keys.tolist(), group.values, strict=True)}
    return covariance, dict(zip(keys, scalars, strict=True)), values


def _poses(front: FrontEnd, covariance: np.ndarray, starts: dict[int, int], values: dict[int, np.ndarray]) -> list:
    """(distance, NEES of the position, NEES of the pose) of each camera but the first."""
    found = []
    for n, truth in enumerate(front.poses[1:], 1):
        here = values[symbol("x", n)]
        start = starts[symbol("x", n)]
        block = covariance[start : start + 6, start : start + 6]
        error = _log(here, truth)
        nees = [float(error[:d] @ np.linalg.solve(block[:d, :d], error[:d])) for d in (3, 6)]
        found.append((float(np.linalg.norm(here[:3] - truth[:3])), *nees))
    return found


def _log(here: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """δ with here ⊞ δ = truth, to first order in the rotation."""
    relative = pose_vector(np.linalg.inv(pose_matrix(here)) @ pose_matrix(truth))
    error = np.concatenate([relative[:3], 2 * relative[3:6]])
    assert np.linalg.norm(boxplus("se3", here, error)[:3] - truth[:3]) < 1e-6
    return error


def _depths(front: FrontEnd, covariance: np.ndarray, starts: dict[int, int], values: dict[int, np.ndarray]) -> list:
    """(σ_ρ/ρ, error in σ_ρ) of features that were seen often; of a point, ρ along the ray from its first camera."""
    found = []
    for track, seen in front.tracks.items():
        if seen.first < 0 or seen.observations < _LASTING:
            continue
        key = symbol("f", track)
        here, start = values[key], starts[key]
        truth = 1 / float(np.linalg.norm(front.world.points[track] - front.poses[seen.first][:3]))
        if here.size == 6:
            rho, sigma = here[5], np.sqrt(covariance[start + 5, start + 5])
        else:
            first = symbol("x", seen.first)
            ray = here - values[first][:3]
            rho = 1 / float(np.linalg.norm(ray))
            slope = -(rho**3) * ray
            J = np.zeros(len(covariance))
            J[start : start + 3] = slope
            if starts[first] >= 0:
                J[starts[first] : starts[first] + 3] = -slope @ pose_matrix(values[first])[:3, :3]
            sigma = np.sqrt(J @ covariance @ J)
        found.append((float(sigma / rho), float((rho - truth) / sigma)))
    return found
