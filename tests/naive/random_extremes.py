"""Inserts with numbers from everywhere in what a map admits: the smallest, the largest, and the same place twice."""

import numpy as np
from naive.dense_derived import is_derived, parts_of, with_further
from naive.dense_least_squares import CONNECTS
from naive.random_camera_factors import CAMERA_KINDS, measurement
from naive.random_cameras import CAMERAS
from naive.random_others import LINEAR

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

MOST, MOST_INFORMATION = 1e12, 1e24
SIZES = {
    "se2": 3,
    "se3": 7,
    "so3": 4,
    "sim3": 8,
    "point2": 2,
    "point3": 3,
    "idp": 6,
    "vector1": 1,
    "vector2": 2,
    "vector3": 3,
    "vector9": 9,
}
TURNED_AT = {"se3": 3, "so3": 0, "sim3": 3}  # where the quaternion is
# Where a measured rotation or similarity has its quaternion.
SIMILAR = {"prior_so3": 0, "between_so3": 0, "prior_sim3": 3, "between_sim3": 3}
LOSSES = ("", "", "", "huber", "cauchy", "geman-mcclure", "tukey", "dcs")
LETTERS = {
    "se2": "x",
    "se3": "y",
    "so3": "r",
    "sim3": "m",
    "point2": "l",
    "point3": "p",
    "idp": "f",
    "vector1": "s",
    "vector2": "a",
    "vector3": "v",
    "vector9": "b",
}


def number(rng: np.random.Generator) -> float:
    """Any size that is admitted: often an ordinary one, or one of the ends."""
    how = rng.random()
    if how < 0.35:
        return float(rng.normal(0, 3))
    if how < 0.45:
        return float(rng.choice([0.0, -0.0, MOST, -MOST, 5e-324, 1.0]))
    exponent = rng.uniform(-320, 12) if how < 0.7 else rng.uniform(-12, 12)
    return float(rng.choice([-1.0, 1.0]) * min(10.0**exponent, MOST))


def numbers(count: int, rng: np.random.Generator) -> np.ndarray:
    return np.array([number(rng) for _ in range(count)])


def quaternion(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4) if rng.random() < 0.5 else rng.permutation([1.0, 1e-9, 0.0, -1e-200])
    return q / np.linalg.norm(q)


def scale(rng: np.random.Generator) -> float:
    """Of a sim3, within what is admitted."""
    return float(np.clip(10.0 ** rng.uniform(-12.5, 12.5), 1.0 / MOST, MOST))


def value(kind: str, others: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Of a variable; at times where another one is, or next to it."""
    made = numbers(SIZES[kind], rng)
    if others and rng.random() < 0.3:
        near = others[int(rng.integers(len(others)))]
        n = min(2 if kind.endswith("2") else 3, near.size, made.size)
        made[:n] = near[:n] + rng.choice([0.0, 1e-200, 1e-12, 1.0]) * rng.normal(size=n)
    if kind in TURNED_AT:
        made[TURNED_AT[kind] : TURNED_AT[kind] + 4] = quaternion(rng)
    if kind == "sim3":
        made[7] = scale(rng)
    return np.clip(made, -MOST, MOST)


def information(dim: int, rng: np.random.Generator) -> np.ndarray:
    """The upper triangle of a positive definite matrix: σ from 1e-12 to 1e12, each by itself or all alike."""
    exponents = rng.uniform(-11.9, 11.9, dim) if rng.random() < 0.5 else np.full(dim, rng.uniform(-11.9, 11.9))
    if rng.random() < 0.3:
        exponents[:] = rng.uniform(-2, 3)
    root = 10.0**exponents
    correlation = np.eye(dim)
    if rng.random() < 0.5:
        J = rng.normal(size=(dim, dim))
        S = J @ J.T + np.eye(dim)
        correlation = S / np.sqrt(np.outer(S.diagonal(), S.diagonal()))
    return (correlation * np.outer(root, root))[np.triu_indices(dim)]


def measured(kind: str, rng: np.random.Generator) -> np.ndarray:
    if is_derived(kind):
        return with_further(kind, measured(parts_of(kind)[0], rng), rng)
    if kind in CAMERA_KINDS:
        z = measurement(kind, CAMERAS["radtan"], np.zeros(2), number(rng) if kind == "idp_first" else 0.0)
        z[:2] = rng.uniform(0, 500, 2) if rng.random() < 0.7 else numbers(2, rng)
        return z
    z = numbers(FACTOR_KINDS[kind].size, rng)
    if kind in SIMILAR:
        z[SIMILAR[kind] : SIMILAR[kind] + 4] = quaternion(rng)
        if z.size == SIZES["sim3"]:
            z[7] = scale(rng)
        return z
    if kind.startswith(("range", "bearing_range", "length")):
        z[-1] = abs(z[-1]) or 1.0
    at = 0
    for end in connects(kind) if kind.startswith("linear") else ["se3"] if z.size == 7 else []:
        if end == "se3":
            z[at + 3 : at + 7] = quaternion(rng)
        at += SIZES[end]
    return z


def connects(kind: str) -> list[str]:
    """The kinds of variables that a kind of factor is on."""
    if is_derived(kind) or kind.startswith(("linear", "velocity", "length")):
        return CONNECTS[kind]
    if kind.startswith("prior_"):
        return [kind.removeprefix("prior_")]
    if kind.startswith(("position", "heading", "attitude")):
        return [kind.rpartition("_")[2]]
    if kind.startswith(("between", "range_between")):
        return [kind.rpartition("_")[2]] * 2
    if kind in CAMERA_KINDS:
        return ["se3", "point3" if kind == "point_seen" else "idp"]
    return [kind.rpartition("_")[2], "point2" if kind.endswith("se2") else "point3"]


class Extremes:
    """One map: its inserts in turn.  `known` has what was accepted; tell it with `accept`."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.known: dict[str, list[int]] = {kind: [] for kind in SIZES}
        self.values: list[np.ndarray] = []
        self._count = 0

    def begin(self) -> Batch:
        """Something of every kind, held where it is."""
        return Batch(tuple(self._variable(kind, fixed=True) for kind in SIZES))

    def next(self) -> Batch:
        """One or two new variables, and factors between what there is."""
        rng = self.rng
        kinds = rng.choice(list(SIZES), int(rng.integers(0, 3)), replace=False)
        variables = tuple(self._variable(str(kind), fixed=False) for kind in kinds)
        new = {group.kind: int(group.keys[0]) for group in variables}
        alone = [f"prior_{kind}" if f"prior_{kind}" in FACTOR_KINDS else f"linear_{SIZES[kind]}_{kind}" for kind in new]
        factors = [self._factor(kind, new) for kind in alone if rng.random() < 0.7]
        factors += [
            self._factor(str(kind), new) for kind in rng.choice([*FACTOR_KINDS, *LINEAR], int(rng.integers(0, 4)))
        ]
        return Batch(variables, tuple(factor for factor in factors if factor is not None))

    def accept(self, batch: Batch) -> None:
        for group in batch.variables:
            self.known[group.kind] += group.keys.tolist()
            if group.values is not None:
                self.values.append(group.values[0])

    def _variable(self, kind: str, fixed: bool) -> Variables:
        self._count += 1
        key = np.array([symbol(LETTERS[kind], self._count)])
        given = fixed or self.rng.random() < 0.8
        return Variables(kind, key, value(kind, self.values, self.rng)[None] if given else None, fixed)

    def _factor(self, kind: str, new: dict[str, int]) -> Factors | None:
        rng, keys = self.rng, list[int]()
        for end in connects(kind):
            there = [key for key in self.known[end] if key not in keys]
            there = [new[end]] if end in new and new[end] not in keys and rng.random() < 0.8 else there
            if not there:
                return None
            keys.append(there[int(rng.integers(len(there)))])
        made = Factors(
            kind, np.array([keys]), measured(kind, rng)[None], information(FACTOR_KINDS[kind].dim, rng)[None]
        )
        loss = str(rng.choice(LOSSES))
        return made._replace(loss=loss, scale=np.array([10.0 ** rng.uniform(-12, 12)])) if loss else made
