"""Drives of a rotation alone, and of monocular keyframes whose scale drifts, which see points and close loops."""

from collections.abc import Iterator

import numpy as np
from naive.dense_factors import TANGENT, boxminus, boxplus
from naive.dense_similar import measured
from naive.random_graphs import random_information

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

SIMILAR = {name for name in FACTOR_KINDS if name.endswith(("so3", "sim3"))}
LINEAR_SIMILAR = ("linear_3_so3", "linear_7_sim3", "linear_8_sim3_so3_point3")


def similar_steps(seed: int, steps: int = 8, noise: float = 0.02, loss: str = "") -> Iterator[Batch]:
    """All of these kinds occur; everything comes without values, in mixed directions."""
    rng, truth = np.random.default_rng(seed), dict[int, np.ndarray]()

    def new(kind: str, letter: str, index: int, value: np.ndarray) -> Variables:
        truth[symbol(letter, index)] = value
        return Variables(kind, np.array([symbol(letter, index)]))

    def made(kind: str, *keys: int) -> Factors:
        z = measured(kind, [truth[key] for key in keys], noise, rng)
        group = Factors(kind, np.array([keys]), z[None], random_information(FACTOR_KINDS[kind].dim, rng)[None])
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    def linear(kind: str, *keys: int) -> Factors:
        of, rows = kind.split("_")[2:], FACTOR_KINDS[kind].dim
        y = [boxplus(end, truth[key], 0.1 * rng.normal(size=TANGENT[end])) for end, key in zip(of, keys, strict=True)]
        H = [np.eye(rows, TANGENT[end]) + 0.2 * rng.normal(size=(rows, TANGENT[end])) for end in of]
        off = sum(J @ boxminus(end, truth[key], at) for J, end, key, at in zip(H, of, keys, y, strict=True))
        b = -off + noise * rng.normal(size=rows)
        z = np.concatenate([*y, *(J.ravel() for J in H), b])
        return Factors(kind, np.array([keys]), z[None], random_information(rows, rng)[None])

    turned = np.array([0, 0, 0, 1.0])
    for n in range(steps):
        r, y, p = (symbol(letter, n) for letter in "ryp")
        turn, pose = turned, np.array([0, 0, 0, *turned, 0.8])
        if n:
            turn = boxplus("so3", truth[r - 1], rng.normal(0, 0.4, 3))
            pose = boxplus("sim3", truth[y - 1], np.array([1.0, 0, 0.1, *rng.normal(0, 0.3, 3), rng.normal(0, 0.15)]))
        point = pose[:3] + rng.normal(0, 2, 3)
        variables = [new("so3", "r", n, turn), new("sim3", "y", n, pose), new("point3", "p", n, point)]
        if n == 0:
            factors = [made("prior_so3", r), made("prior_sim3", y)]
        else:
            back = n % 2
            factors = [made("between_so3", *((r - 1, r) if back else (r, r - 1)))]
            factors.append(made("between_sim3", *((y, y - 1) if back else (y - 1, y))))
            factors += [made("landmark_sim3", y, p - 1), made("attitude_so3", r), made("position_sim3", y)]
        if n > 3:
            factors += [made("between_so3", r - 3, r), made("between_sim3", y - 4, y)]
            factors += [linear("linear_3_so3", r), linear("linear_7_sim3", y)]
            factors.append(linear("linear_8_sim3_so3_point3", y, r, p - 1))
        factors.append(made("landmark_sim3", y, p))
        yield Batch(tuple(variables), tuple(factors))
