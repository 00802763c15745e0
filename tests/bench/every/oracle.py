"""The batch optimum once more, by NumPy and SciPy alone: what the judge's full passes are held against.

Nothing here shares a formula with the kernels: residuals are those of `replays.chi2`, Jacobians are central
differences, and the normal equations are a SciPy matrix.  A step takes seconds, so it is asked at a few of them.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from bench.replays.chi2 import RESIDUALS
from bench.replays.columns import F64, I64, symmetric
from bench.replays.own_kinds import USUAL
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from factorbus.proto.messages import Batch
from factorbus.solver import Group

from .newton import newton_steps

_TANGENT = {"se2": 3, "se3": 6, "point2": 2, "point3": 3}
_H = 1e-6  # metres and radians of a central difference
_DONE, _MOST_PASSES, _MOST_DAMPING = 1e-10, 200, 1e12
_FIRST_DAMPING = 1e-5
_LEAST_DAMPING = 1e-10  # along what is hardly known an undamped step leads too far, and one with much hardly moves
_DIFFERENCES = 1e-8  # of χ²: what Jacobians by differences want to gain where neither they nor Newton's steps lower it
_ROUNDING = 1e-14  # of χ²: a hardly damped step that wants to gain less ends, for differences may bar undamped ones


class _Factors(NamedTuple):
    """Of one kind and loss: keys (m, ends), z (m, size), roots (m, r, r) with Ω = rootsᵀ roots, scale (m,)."""

    kind: str
    loss: str
    keys: I64
    z: F64
    roots: F64
    scale: F64


class Oracle:
    """Takes in what a solver takes in, and finds the optimum from an estimate."""

    def __init__(self) -> None:
        self._kinds: dict[int, str] = {}
        self._fixed: set[int] = set()
        self._factors: list[_Factors] = []

    def take_in(self, batch: Batch) -> None:
        """The next step."""
        for group in batch.variables:
            self._kinds |= dict.fromkeys(group.keys.tolist(), group.kind)
            self._fixed |= set(group.keys.tolist()) if group.fixed else set()
        for group in batch.factors:
            roots = np.linalg.cholesky(symmetric(group.information)).transpose(0, 2, 1)
            scale = np.ones(len(group.keys)) if group.scale is None else group.scale
            self._factors.append(_Factors(group.kind, group.loss, group.keys, group.measured, roots, scale))

    def optimum(self, estimate: Iterable[Group]) -> tuple[float, float]:
        """χ² at an estimate of all variables, and at the optimum from there.  Raises ArithmeticError: none is found."""
        values = {int(key): row for group in estimate for key, row in zip(group.keys, group.values, strict=True)}
        problem = _Problem(self._kinds, self._fixed, _joined(self._factors))
        x = problem.rows(values)
        first = chi2 = problem.chi2(x)
        damping = 0.0
        if not problem.count:
            return first, first
        for _ in range(_MOST_PASSES):
            delta, decrease = problem.step(x, damping)
            trial = problem.moved(x, delta)
            reached = problem.chi2(trial)
            wanted = _DONE if damping == 0.0 else _ROUNDING
            if damping <= _FIRST_DAMPING and decrease <= wanted * max(chi2, 1.0):
                return first, min(chi2, reached)
            if damping == 0.0 and not reached <= chi2:
                trial, reached = problem.best(x, chi2)
                if not reached <= chi2 and decrease <= _DIFFERENCES * max(chi2, 1.0):
                    return first, chi2
            if reached <= chi2:
                x, chi2, damping = trial, reached, 0.1 * damping if damping > _LEAST_DAMPING else 0.0
            elif damping > _MOST_DAMPING:
                break
            else:
                damping = max(10 * damping, _LEAST_DAMPING)
        raise ArithmeticError(f"no optimum after {_MOST_PASSES} passes; χ² is {chi2:.9g}")


class _Problem:
    """A graph as tables: values of a kind are the rows of one array."""

    def __init__(self, kinds: dict[int, str], fixed: set[int], factors: list[_Factors]) -> None:
        self._keys = {kind: np.array([k for k, own in kinds.items() if own == kind]) for kind in set(kinds.values())}
        self._where = {int(key): n for keys in self._keys.values() for n, key in enumerate(keys)}
        self._starts, count = {}, 0
        for kind, keys in self._keys.items():
            free = np.array([key not in fixed for key in keys.tolist()])
            self._starts[kind] = np.where(free, count + _TANGENT[kind] * (np.cumsum(free) - 1), -1)
            count += _TANGENT[kind] * int(free.sum())
        self.count = count
        self._factors = [(each, self._ends(kinds, each.keys)) for each in factors]

    def rows(self, values: dict[int, F64]) -> dict[str, F64]:
        """Values by key as tables.  Raises KeyError for one that is missing."""
        return {kind: np.array([values[key] for key in keys.tolist()]) for kind, keys in self._keys.items()}

    def chi2(self, x: dict[str, F64]) -> float:
        """Σ ρ(rᵀΩr)."""
        return sum(float(rho(f.loss, f.scale, (self._whitened(f, e, x) ** 2).sum(1)).sum()) for f, e in self._factors)

    def step(self, x: dict[str, F64], damping: float) -> tuple[F64, float]:
        """δ of the normal equations with diagonal Λ (1 + damping), and the decrease of χ² that the model tells."""
        information, eta = self._normal(x)
        delta = _solver(csc_array(information + damping * diags_array(information.diagonal())))(eta)
        return delta, float(delta @ eta)

    def best(self, x: dict[str, F64], chi2: float) -> tuple[dict[str, F64], float]:
        """Where one of Newton's steps leads that lowers χ², and χ² there; infinite where none does."""
        information, eta = self._normal(x)
        for delta in newton_steps(eta, lambda d: self._normal(self.moved(x, d))[1], _solver(information)):
            trial = self.moved(x, delta)
            reached = self.chi2(trial)
            if reached <= chi2:
                return trial, reached
        return x, np.inf

    def _normal(self, x: dict[str, F64]) -> tuple[csc_array, F64]:
        """Λ and η."""
        rows, columns, entries, wanted, count = [], [], [], [], 0
        for f, ends in self._factors:
            r = self._whitened(f, ends, x)
            weights = np.sqrt(_slope(f.loss, f.scale, (r**2).sum(1)))
            wanted.append((-weights[:, None] * r).ravel())
            at = count + np.arange(r.size).reshape(r.shape)
            for n, (kind, index) in enumerate(ends):
                J = weights[:, None, None] * self._jacobian(f, ends, n, x)
                own = self._starts[kind][index]
                place = np.broadcast_to((own[:, None] + np.arange(_TANGENT[kind]))[:, None, :], J.shape)
                free = np.broadcast_to((own >= 0)[:, None, None], J.shape)
                rows.append(np.broadcast_to(at[:, :, None], J.shape)[free])
                columns.append(place[free])
                entries.append(J[free])
            count += r.size
        index = np.concatenate(rows), np.concatenate(columns)
        J, r = csc_array((np.concatenate(entries), index), shape=(count, self.count)), np.concatenate(wanted)
        return csc_array(J.T @ J), J.T @ r

    def moved(self, x: dict[str, F64], delta: F64) -> dict[str, F64]:
        """x ⊞ δ."""
        found, delta = {}, np.append(delta, np.zeros(max(_TANGENT.values())))  # behind it: of what is fixed
        for kind, table in x.items():
            starts = self._starts[kind]
            own = np.where(starts[:, None] >= 0, delta[starts[:, None] + np.arange(_TANGENT[kind])], 0.0)
            found[kind] = boxplus(kind, table, own)
        return found

    def _ends(self, kinds: dict[int, str], keys: I64) -> list[tuple[str, I64]]:
        """(kind, rows in its table) of each end."""
        return [(kinds[int(end[0])], np.array([self._where[key] for key in end.tolist()])) for end in keys.T]

    def _whitened(self, f: _Factors, ends: list[tuple[str, I64]], x: dict[str, F64]) -> F64:
        return self._at(f, [x[kind][index] for kind, index in ends])

    def _at(self, f: _Factors, values: list[F64]) -> F64:
        r = RESIDUALS[USUAL.get(f.kind, f.kind)](values[0], values[-1], f.z)
        return np.einsum("mij,mj->mi", f.roots, r)

    def _jacobian(self, f: _Factors, ends: list[tuple[str, I64]], n: int, x: dict[str, F64]) -> F64:
        """∂(√Ω r)/∂δ of one end (m, r, d)."""
        values, kind = [x[end][index] for end, index in ends], ends[n][0]

        def off(c: int, h: float) -> F64:
            delta = np.zeros((len(values[n]), _TANGENT[kind]))
            delta[:, c] = h
            return self._at(f, [*values[:n], boxplus(kind, values[n], delta), *values[n + 1 :]])

        return np.stack([(off(c, _H) - off(c, -_H)) / (2 * _H) for c in range(_TANGENT[kind])], axis=2)


def _solver(matrix: csc_array) -> Callable[[F64], F64]:
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve


def boxplus(kind: str, x: F64, delta: F64) -> F64:
    """x ⊞ δ of rows: x Exp(δ) of poses with the translation in the pose's frame, else the sum."""
    if kind.startswith("point"):
        return x + delta
    if kind == "se2":
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        dx, dy, turn = delta.T
        return np.stack((x[:, 0] + c * dx - s * dy, x[:, 1] + s * dx + c * dy, x[:, 2] + turn), axis=1)
    R = Rotation.from_quat(x[:, 3:])
    quaternions = (R * Rotation.from_rotvec(delta[:, 3:])).as_quat()
    return np.concatenate((x[:, :3] + R.apply(delta[:, :3]), quaternions), axis=1)


def rho(loss: str, k: F64, s: F64) -> F64:
    """ρ(s).  Raises KeyError for a loss that is not in `_LOSSES`."""
    return s if not loss else _LOSSES[loss](k, s)[0]


def _slope(loss: str, k: F64, s: F64) -> F64:
    return np.ones_like(s) if not loss else _LOSSES[loss](k, s)[1]


def _huber(k: F64, s: F64) -> tuple[F64, F64]:
    root = np.sqrt(np.maximum(s, k * k))
    return np.where(s <= k * k, s, 2 * k * root - k * k), np.where(s <= k * k, 1.0, k / root)


_LOSSES: dict[str, Callable[[F64, F64], tuple[F64, F64]]] = {"huber": _huber}


def _joined(factors: list[_Factors]) -> list[_Factors]:
    """One for each kind and loss."""
    found: dict[tuple[str, str], list[_Factors]] = {}
    for each in factors:
        found.setdefault((each.kind, each.loss), []).append(each)
    return [
        _Factors(*named, *(np.concatenate([each[n] for each in parts]) for n in range(2, 6)))
        for named, parts in found.items()
    ]
