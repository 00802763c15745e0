"""Single random factors of the kinds that place nobody, and graphs that grow with them."""

from collections.abc import Iterator

import numpy as np
from naive.dense_factors import TANGENT, boxminus, boxplus, linear_ends, pose_matrix
from naive.random_graphs import factor, random_information, random_value

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

SIMILAR_ENDS = ("so3", "sim3")  # of rotations and similarities: `random_similar`
_BEGINNINGS = ("position", "heading", "attitude", "range", "bearing_se", "velocity", "length")
# Of one variable, of two, and of more, with fewer rows than they have scalars, as many, and one more.
LINEAR = (
    *("linear_3_se2", "linear_6_se3", "linear_2_point2", "linear_3_point3", "linear_6_idp", "linear_1_se3"),
    *("linear_3_se2_se2", "linear_6_se3_se3", "linear_2_point2_point2", "linear_3_point3_point3", "linear_6_idp_idp"),
    *("linear_2_se2_point2", "linear_3_se3_point3", "linear_6_se3_idp", "linear_3_point3_idp", "linear_5_point2_se2"),
    *("linear_8_se2_se2_point2", "linear_9_se3_point3_idp", "linear_7_point3_se3_se3", "linear_9_se2_point2_se2"),
    *("linear_9_vector9", "linear_1_vector1_vector1", "linear_7_se3_vector9_se3", "linear_3_se2_vector1_vector9"),
)
OTHERS = (
    *(
        name
        for name, kind in FACTOR_KINDS.items()
        if name.startswith(_BEGINNINGS) and not kind.base and not name.endswith(SIMILAR_ENDS)
    ),
    *LINEAR,
)


def random_other(kind: str, ends: list[np.ndarray], noise: float, rng: np.random.Generator) -> np.ndarray:
    """What a factor of such a kind would measure at these values, with noise."""
    if kind.startswith("linear"):
        return _random_linear(kind, ends, noise, rng)
    if kind == "length_vector3":
        return np.array([abs(np.linalg.norm(ends[0]) + noise * rng.normal())])
    T = pose_matrix(ends[0])
    n = len(T) - 1
    if kind.startswith("velocity"):
        return T[:n, :n] @ ends[1] + noise * rng.normal(size=n)
    if kind.startswith("position"):
        lever = rng.normal(0, 0.5, n)
        return np.concatenate([(T @ np.append(lever, 1.0))[:n] + noise * rng.normal(size=n), lever])
    if kind == "heading_se2":
        return ends[0][2:] + noise * rng.normal(size=1)
    if kind == "attitude_se3":
        there = rng.normal(size=3)
        seen = T[:3, :3].T @ there / np.linalg.norm(there) + noise * rng.normal(size=3)
        return np.concatenate([2.0 * seen, there])
    if kind.startswith("range_between"):
        return np.array([abs(np.linalg.norm(ends[1][:n] - ends[0][:n]) + noise * rng.normal())])
    seen = (np.linalg.inv(T) @ np.append(ends[1], 1.0))[:-1]
    if kind.startswith("range"):
        return np.array([abs(np.linalg.norm(seen) + noise * rng.normal())])
    if kind == "bearing_se2":
        return np.array([np.arctan2(seen[1], seen[0]) + noise * rng.normal()])
    return 3.0 * (seen / np.linalg.norm(seen) + noise * rng.normal(size=3))


def _random_linear(kind: str, ends: list[np.ndarray], noise: float, rng: np.random.Generator) -> np.ndarray:
    of, rows = linear_ends(kind), FACTOR_KINDS[kind].dim
    y = [boxplus(end, x, 0.1 * rng.normal(size=TANGENT[end])) for end, x in zip(of, ends, strict=True)]
    H = [
        np.eye(rows, TANGENT[end]) * (1 if e else -1) + 0.2 * rng.normal(size=(rows, TANGENT[end]))
        for e, end in enumerate(of)
    ]
    off = sum(J @ boxminus(end, x, at) for J, end, x, at in zip(H, of, ends, y, strict=True))
    return np.concatenate([*y, *(J.ravel() for J in H), noise * rng.normal(size=rows) - off])


def other_steps(seed: int, steps: int = 8, noise: float = 0.03, loss: str = "") -> Iterator[Batch]:
    """A robot in the plane and one in space; all of these kinds occur, and what they alone leave free is held."""
    rng = np.random.default_rng(seed)
    truth: dict[int, np.ndarray] = {}

    def new(kind: str, letter: str, index: int, value: np.ndarray, given: bool = False) -> Variables:
        truth[symbol(letter, index)] = value
        return Variables(kind, np.array([symbol(letter, index)]), value[None] if given else None)

    def made(kind: str, *keys: int) -> Factors:
        z = random_other(kind, [truth[key] for key in keys], noise, rng)
        information = random_information(FACTOR_KINDS[kind].dim, rng)
        group = Factors(kind, np.array([keys]), z[None], information[None])
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    for n in range(steps):
        x, y, l, p, f, s, b = (symbol(letter, n) for letter in "xylpfsb")
        plane, space = random_value("se2", rng), random_value("se3", rng)
        if n:
            plane = boxplus("se2", truth[x - 1], np.array([1.0, 0.1, rng.normal(0, 0.6)]))
            space = boxplus("se3", truth[y - 1], np.array([1, 0, 0.1, *rng.normal(0, 0.4, 3)]))
        variables = [new("se2", "x", n, plane), new("se3", "y", n, space)]
        variables += [new("point2", "l", n, plane[:2] + rng.uniform(1, 3, 2), given=True)]
        variables += [new("point3", "p", n, space[:3] + rng.uniform(1, 3, 3), given=True)]
        variables += [new("idp", "f", n, random_value("idp", rng), given=True)]
        variables += [new("vector1", "s", n, random_value("vector1", rng), given=True)]
        variables += [new("vector9", "b", n, random_value("vector9", rng), given=True)]
        if n == 0:
            factors = [factor("prior_se2", [x], truth, noise, rng), factor("prior_se3", [y], truth, noise, rng)]
            factors += [made("linear_1_vector1", s)]
        else:
            factors = [factor("between_se2", [x - 1, x], truth, noise, rng)]
            factors += [factor("between_se3", [y - 1, y], truth, noise, rng)]
            factors += [made("linear_3_se2_se2", x - 1, x), made("linear_6_se3_se3", y, y - 1)]
            factors += [made("range_se2", x, l - 1), made("bearing_se3", y, p - 1)]
            factors += [made("linear_2_point2_point2", l, l - 1), made("linear_3_point3_point3", p - 1, p)]
            factors += [made("linear_2_se2_point2", x, l - 1), made("linear_3_se3_point3", y - 1, p)]
            factors += [made("linear_6_idp_idp", f, f - 1), made("linear_6_se3_idp", y, f - 1)]
            factors += [made("linear_3_point3_idp", p - 1, f)]
            factors += [made("range_between_se2", x, x - 1), made("range_between_se3", y - 1, y)]
            factors += [made("linear_8_se2_se2_point2", x, x - 1, l), made("linear_9_se3_point3_idp", y - 1, p, f)]
            factors += [made("linear_7_point3_se3_se3", p - 1, y, y - 1), made("linear_5_point2_se2", l - 1, x)]
            factors += [made("linear_7_se3_vector9_se3", y - 1, b, y), made("linear_1_vector1_vector1", s - 1, s)]
            factors += [made("linear_3_se2_vector1_vector9", x, s, b - 1)]
        factors += [
            made("linear_6_idp", f),
            made("linear_9_vector9", b),
            made("range_se2", x, l),
            made("bearing_se2", x, l),
            made("range_se3", y, p),
            made("bearing_se3", y, p),
        ]
        factors += [factor("prior_point2", [l], truth, noise, rng), factor("prior_point3", [p], truth, noise, rng)]
        if n % 2:
            factors += [made(kind, x) for kind in ("position_se2", "heading_se2", "linear_3_se2")]
            factors += [made("linear_2_point2", l), made("linear_3_point3", p)]
            factors += [made(kind, y) for kind in ("position_se3", "attitude_se3", "linear_6_se3")]
        yield Batch(tuple(variables), tuple(factors))
