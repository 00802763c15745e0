"""A factor graph solved with dense matrices: the twin of the solver."""

from collections.abc import Iterator

import numpy as np
from naive.dense_derived import parts_of
from naive.dense_factors import TANGENT, boxminus, boxplus, jacobians, linear_ends, residual

from factorbus.proto.inertial import form_of_name


class Connects(dict[str, list[str]]):
    """The kinds of the variables of each kind of factor; a linear one, or one with further variables, by its name; the
    same of all inertial ones."""

    def __missing__(self, kind: str) -> list[str]:
        base, modifiers = parts_of(kind)
        if modifiers:
            space = self[base][0]
            of = {"mount": space, "frame": space, "arm": "vector2" if space == "se2" else "vector3"}
            of |= {"bundler": "vector3", "intrinsics": "vector9"}
            return [*self[base], *(of.get(modifier, "vector1") for modifier in modifiers)]
        if kind.startswith("imu_"):
            return list(form_of_name(kind).ends)
        assert kind.startswith("linear_"), kind
        return linear_ends(kind)


CONNECTS = Connects({
    "prior_se2": ["se2"],
    "prior_se3": ["se3"],
    "prior_point2": ["point2"],
    "prior_point3": ["point3"],
    "between_se2": ["se2", "se2"],
    "between_se3": ["se3", "se3"],
    "landmark_se2": ["se2", "point2"],
    "landmark_se3": ["se3", "point3"],
    "bearing_range_se2": ["se2", "point2"],
    "idp_first": ["se3", "idp"],
    "idp_seen": ["se3", "idp"],
    "point_seen": ["se3", "point3"],
    "position_se2": ["se2"],
    "position_se3": ["se3"],
    "heading_se2": ["se2"],
    "attitude_se3": ["se3"],
    "range_se2": ["se2", "point2"],
    "range_se3": ["se3", "point3"],
    "range_between_se2": ["se2", "se2"],
    "range_between_se3": ["se3", "se3"],
    "velocity_frame_se2": ["se2", "vector2"],
    "velocity_frame_se3": ["se3", "vector3"],
    "length_vector3": ["vector3"],
    "bearing_se2": ["se2", "point2"],
    "bearing_se3": ["se3", "point3"],
    "prior_so3": ["so3"],
    "between_so3": ["so3", "so3"],
    "attitude_so3": ["so3"],
    "prior_sim3": ["sim3"],
    "between_sim3": ["sim3", "sim3"],
    "landmark_sim3": ["sim3", "point3"],
    "position_sim3": ["sim3"],
})  # fmt: skip


class DenseGraph:
    """Variables by key in insertion order, factors in a list."""

    def __init__(self) -> None:
        self.kinds: dict[int, str] = {}
        self.fixed: set[int] = set()
        self.values: dict[int, np.ndarray] = {}
        self.factors: list[tuple[str, list[int], np.ndarray, np.ndarray]] = []
        self.losses: list[tuple[str, float]] = []

    def add(self, batch) -> None:
        """Take in a batch; values come by `put`."""
        for group in batch.variables:
            for key in group.keys.tolist():
                self.kinds[key] = group.kind
                if group.fixed:
                    self.fixed.add(key)
        for group in batch.factors:
            scales = np.ones(len(group.keys)) if group.scale is None else group.scale
            for keys, z, upper, k in zip(group.keys.tolist(), group.measured, group.information, scales, strict=True):
                self.factors.append((group.kind, keys, z, full(upper)))
                self.losses.append((group.loss, float(k)))

    def put(self, groups) -> None:
        """Take over values."""
        for group in groups:
            self.values.update(zip(group.keys.tolist(), group.values, strict=True))

    def chi2(self) -> float:
        total = 0.0
        for rows, ends, z in self._alike():
            kind, *_ = self.factors[rows[0]]
            for n, r in zip(rows, residual(kind, ends, z), strict=True):
                loss, k = self.losses[n]
                total += rho(loss, k, r @ self.factors[n][3] @ r)
        return float(total)

    def _alike(self) -> Iterator[tuple[list[int], list[np.ndarray], np.ndarray]]:
        """Factors of one kind together: which they are, the values of their ends, what they have measured."""
        alike: dict[tuple[str, int], list[int]] = {}
        for n, (kind, _, z, _) in enumerate(self.factors):
            alike.setdefault((kind, len(z)), []).append(n)
        for rows in alike.values():
            of = [self.factors[n] for n in rows]
            ends = [
                np.array([self.values[key] for key in keys]) for keys in zip(*(keys for _, keys, *_ in of), strict=True)
            ]
            yield rows, ends, np.array([z for _, _, z, _ in of])

    def starts(self) -> dict[int, int]:
        """First scalar of every free variable."""
        found, n = {}, 0
        for key, kind in self.kinds.items():
            if key not in self.fixed:
                found[key] = n
                n += TANGENT[kind]
        return found

    def system(self) -> tuple[np.ndarray, np.ndarray]:
        """(Λ, η) at the present values."""
        starts = self.starts()
        n = sum(TANGENT[self.kinds[key]] for key in starts)
        information, eta = np.zeros((n, n)), np.zeros(n)
        for rows, ends, z in self._alike():
            kind, *_ = self.factors[rows[0]]
            Js = jacobians(kind, CONNECTS[kind], ends, z)
            for row, r, *J in zip(rows, residual(kind, ends, z), *Js, strict=True):
                (_, keys, _, W), (loss, k) = self.factors[row], self.losses[row]
                if loss:
                    W = W * weight(loss, k, r @ W @ r)
                free = [e for e, key in enumerate(keys) if key in starts]
                if not free:
                    continue
                H = np.hstack([J[e] for e in free])
                at = np.concatenate([starts[keys[e]] + np.arange(J[e].shape[1]) for e in free])
                information[np.ix_(at, at)] += H.T @ W @ H
                eta[at] -= H.T @ W @ r
        return information, eta

    def gauss_newton(self, iterations: int) -> float:
        """That many steps, or until nothing moves; gives the length of the last one."""
        length = np.inf
        for _ in range(iterations):
            information, eta = self.system()
            delta = np.linalg.solve(information, eta)
            length = float(np.abs(delta).max())
            for key, start in self.starts().items():
                kind = self.kinds[key]
                self.values[key] = boxplus(kind, self.values[key], delta[start : start + TANGENT[kind]])
            if length < 1e-12:
                break
        return length


def rho(loss: str, k: float, s: float) -> float:
    """What a factor with rᵀ Ω r = s counts."""
    if loss == "huber":
        return s if s <= k**2 else 2 * k * s**0.5 - k**2
    if loss == "cauchy":
        return k**2 * np.log(1 + s / k**2)
    if loss == "geman-mcclure":
        return k**2 * s / (k**2 + s)
    if loss == "tukey":
        return k**2 / 3 * (1 - max(1 - s / k**2, 0) ** 3)
    if loss == "dcs":
        return s if s <= k**2 else k**2 * (3 * s - k**2) / (s + k**2)
    if loss:
        raise KeyError(f"no twin of the loss {loss!r}")
    return s


def weight(loss: str, k: float, s: float) -> float:
    """∂ρ/∂s by a central difference."""
    h = 1e-6 * max(s, 1.0)
    return (rho(loss, k, s + h) - rho(loss, k, max(s - h, 0.0))) / (h + min(s, h))


def full(upper: np.ndarray) -> np.ndarray:
    """The symmetric matrix with this upper triangle, row by row."""
    n = int((np.sqrt(8 * len(upper) + 1) - 1) / 2)
    matrix = np.zeros((n, n))
    matrix[np.triu_indices(n)] = upper
    return matrix + np.triu(matrix, 1).T


def distance(kind: str, a: np.ndarray, b: np.ndarray) -> float:
    """How far two values of a kind are apart; angles modulo 2π, quaternions up to sign."""
    if kind == "se2":
        return float(max(np.abs(a[:2] - b[:2]).max(), abs(np.angle(np.exp(1j * (a[2] - b[2]))))))
    if kind == "idp":
        return float(max(np.abs(a - b)[[0, 1, 2, 4, 5]].max(), abs(np.angle(np.exp(1j * (a[3] - b[3]))))))
    if kind == "se3":
        return float(max(np.abs(a[:3] - b[:3]).max(), min(np.abs(a[3:] - b[3:]).max(), np.abs(a[3:] + b[3:]).max())))
    if kind in ("so3", "sim3"):
        return float(np.abs(boxminus(kind, a, b)).max())
    return float(np.abs(a - b).max())
