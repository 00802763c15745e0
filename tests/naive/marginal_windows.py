"""A window over poses with loops whose oldest ones are marginalized, and a dense twin of what is left."""

from dataclasses import dataclass

import numpy as np
from naive.dense_factors import TANGENT, _pose_error, boxplus, pose_matrix
from naive.dense_least_squares import DenseGraph, distance
from naive.solver_parts import graph_in

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks

MODES = ("bayes-tree", "inc-l", "all-batch")
SIZE = {"se2": 3, "se3": 7}


def x(*names: int) -> np.ndarray:
    return np.array([symbol("x", n) for n in names])


def random_pose(kind: str, rng: np.random.Generator, step: float = 0.0) -> np.ndarray:
    small = 0.3 * rng.normal(size=TANGENT[kind])
    small[0] += step
    nothing = np.zeros(3) if kind == "se2" else np.array([0.0, 0, 0, 0, 0, 0, 1])
    return boxplus(kind, nothing, small)


def information(rng: np.random.Generator, d: int) -> np.ndarray:
    """A full Ω, with other units for angles."""
    A = rng.normal(size=(d, d)) + 3.0 * np.eye(d)
    units = np.array([10.0] * (d // 2 + d % 2) + [40.0] * (d // 2))
    return ((A.T @ A) * units * units[:, None])[np.triu_indices(d)][None]


def loopy(kind: str, poses: int, seed: int, reach: int = 6) -> Batch:
    """A drive with an odometry edge and two loops a pose, of which none is further back than `reach`."""
    rng, d = np.random.default_rng(seed), TANGENT[kind]
    true = [random_pose(kind, rng)]
    for _ in range(1, poses):
        true.append(_composed(kind, true[-1], random_pose(kind, rng, 1.0)))
    pairs = {(i - 1, i) for i in range(1, poses)}
    pairs |= {(int(rng.integers(max(0, i - reach), i)), i) for i in range(1, poses) for _ in range(2)}
    factors = []
    for i, j in sorted(pairs):
        z = boxplus(kind, relative_pose(kind, true[i], true[j]), 0.01 * rng.normal(size=d))
        factors.append(Factors(f"between_{kind}", x(i, j)[None], z[None], information(rng, d)))
    factors.append(Factors(f"prior_{kind}", x(0)[None], true[0][None], information(rng, d)))
    factors.append(
        Factors(f"prior_{kind}", x(poses - 1)[None], boxplus(kind, true[-1], 0.02 * rng.normal(size=d))[None],
                0.001 * information(rng, d))
    )  # fmt: skip
    return Batch((Variables(kind, x(*range(poses)), np.array(true)),), tuple(factors))


def _vector(T: np.ndarray) -> np.ndarray:
    return np.array([*_pose_error(T)]) if len(T) == 3 else np.array([*_pose_error(T), _last(T)])


def _last(T: np.ndarray) -> float:
    return float(np.sqrt(max(0.0, 1.0 - (_pose_error(T)[3:] ** 2).sum())))


def relative_pose(kind: str, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return _vector(np.linalg.inv(pose_matrix(a)) @ pose_matrix(b))


def _composed(kind: str, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return _vector(pose_matrix(a) @ pose_matrix(b))


def solved(batch: Batch, mode: str = "bayes-tree") -> Solver:
    solver = Solver(Options(mode=mode))
    solver.stage(batch)
    solver.step(settle=True)
    return solver


def values(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {k: (g.kind, row) for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}


def covariance(solver: Solver, *names: int) -> np.ndarray:
    return CovarianceBlocks(solver.covariances.factored()).joint(
        np.array([graph_in(solver).find(key) for key in x(*names).tolist()])
    )


def marginalize(*names: int) -> list[Change]:
    return [Change("marginalize", keys=x(*names))]


def apart(a: Solver, b: Solver) -> float:
    of, there = values(a), values(b)
    return max(distance(kind, row, there[key][1]) for key, (kind, row) in of.items())


@dataclass
class Twin:
    """A dense graph that keeps |R (x ⊟ y) − d|² of some poses, made by a dense Schur complement."""

    graph: DenseGraph
    keys: list[int]
    y: list[np.ndarray]
    R: np.ndarray
    d: np.ndarray

    def error(self) -> np.ndarray:
        e = []
        for key, y in zip(self.keys, self.y, strict=True):
            part = _pose_error(np.linalg.inv(pose_matrix(y)) @ pose_matrix(self.graph.values[key]))
            e.append(part if len(part) == 3 else part * np.array([1, 1, 1, 2, 2, 2]))
        return np.concatenate(e)

    def settle(self) -> None:
        for _ in range(20):
            Lambda, eta = self.graph.system()
            starts, H, column, here = self.graph.starts(), np.zeros((len(self.R), len(eta))), 0, self.error()
            for key in self.keys:
                kind = self.graph.kinds[key]
                n, at = TANGENT[kind], self.graph.values[key]
                J = np.zeros((len(here), n))
                for c in range(n):
                    e = []
                    for h in (-1e-5, 1e-5):
                        self.graph.values[key] = boxplus(kind, at, h * np.eye(n)[c])
                        e.append(self.error())
                    J[:, c] = (e[1] - e[0]) / 2e-5
                self.graph.values[key] = at
                H[:, starts[key] : starts[key] + n] = self.R @ J
                column += n
            r = self.R @ here - self.d
            delta = np.linalg.solve(Lambda + H.T @ H, eta - H.T @ r)
            for key, start in starts.items():
                kind = self.graph.kinds[key]
                step = delta[start : start + TANGENT[kind]]
                self.graph.values[key] = boxplus(kind, self.graph.values[key], step)
            if np.abs(delta).max() < 1e-10:
                break


def twin_of(batch: Batch, estimate: dict[int, tuple[str, np.ndarray]], gone: np.ndarray) -> Twin:
    whole, left = DenseGraph(), DenseGraph()
    whole.add(batch)
    whole.values = {key: row for key, (_, row) in estimate.items()}
    leaving = set(gone.tolist())
    left.kinds = {key: kind for key, kind in whole.kinds.items() if key not in leaving}
    left.values = {key: whole.values[key] for key in left.kinds}
    taken = [not leaving.isdisjoint(keys) for _, keys, _, _ in whole.factors]
    for factor, loss, is_taken in zip(whole.factors, whole.losses, taken, strict=True):
        if not is_taken:
            left.factors.append(factor)
            left.losses.append(loss)
    touched = {key for (_, keys, _, _), of in zip(whole.factors, taken, strict=True) if of for key in keys}
    whole.factors = [factor for factor, of in zip(whole.factors, taken, strict=True) if of]
    whole.losses = [loss for loss, of in zip(whole.losses, taken, strict=True) if of]
    separator = sorted(touched - leaving)
    whole.kinds = {key: whole.kinds[key] for key in [*sorted(leaving), *separator]}
    Lambda, eta = whole.system()
    cut = sum(TANGENT[whole.kinds[key]] for key in leaving)
    gain = np.linalg.solve(Lambda[:cut, :cut], np.column_stack([Lambda[:cut, cut:], eta[:cut]]))
    S, right = Lambda[cut:, cut:] - Lambda[cut:, :cut] @ gain[:, :-1], eta[cut:] - Lambda[cut:, :cut] @ gain[:, -1]
    lam, V = np.linalg.eigh(S)
    known = lam > 1e-12 * lam[-1]
    R = np.sqrt(lam[known])[:, None] * V[:, known].T
    return Twin(
        left, separator, [left.values[key] for key in separator], R, (V[:, known].T @ right) / np.sqrt(lam[known])
    )
