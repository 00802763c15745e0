"""What kinds with further variables measure, and drives in which all of them but those with a mount occur."""

from collections.abc import Iterator

import numpy as np
from naive.dense_derived import base_ends, parts_of
from naive.dense_factors import TANGENT, boxplus, residual
from naive.random_graphs import factor, measured, random_information, random_value
from naive.random_others import OTHERS, random_other

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

_PIXEL = 0.01
_NO_TURN = np.array([0, 0, 0, 0, 0, 0, 1.0])
_LENS = np.array([1.0, 400.0, 401.0, 320.0, 240.0, 0.0, -0.25, 0.125, 0.001, -0.002, 0.0])


def random_derived(
    kind: str, ends: list[np.ndarray], noise: float, rng: np.random.Generator, twist: np.ndarray | None = None
) -> np.ndarray:
    """What a factor of such a kind would measure at these values, with noise; twist: how its robot moves."""
    base, modifiers = parts_of(kind)
    n, size = 2 if "se2" in kind else 3, FACTOR_KINDS[kind].size
    if "arm" in modifiers:
        return residual(kind, ends, np.zeros(size)) + noise * rng.normal(size=size)
    behind = np.zeros(0)
    if "offset" in modifiers:
        behind = rng.normal(0, 0.7, 3 if n == 2 else 6) if twist is None else twist
    plain = [end if modifier != "scale" else np.ones(1) for end, modifier in _with_modifiers(ends, modifiers)]
    seen, _ = base_ends(kind, plain, np.concatenate([np.zeros(size - behind.size), behind]))
    z = (random_other if base in OTHERS else measured)(base, seen, noise, rng)
    if "bias" in modifiers:
        z = abs(z + ends[-1])
    if "scale" in modifiers:
        z[:n] /= ends[-1][0]
    return np.concatenate([z, behind])


def _with_modifiers(ends: list[np.ndarray], modifiers: list[str]) -> Iterator[tuple[np.ndarray, str]]:
    """Each variable with its modifier; those of the base kind have none."""
    return zip(ends, ["", ""][: len(ends) - len(modifiers)] + modifiers, strict=True)


def true_calibration() -> dict[int, tuple[str, np.ndarray]]:
    """Kind and value of biases (b), scales (s), other frames (f), lever arms (a) and offsets of clocks (d)."""
    return {
        symbol("b", 0): ("vector1", np.array([0.4])),
        symbol("b", 1): ("vector1", np.array([-0.3])),
        symbol("s", 0): ("vector1", np.array([1.2])),
        symbol("s", 1): ("vector1", np.array([0.9])),
        symbol("f", 0): ("se2", np.array([4.0, -2.0, 2.5])),
        symbol("f", 1): ("se3", boxplus("se3", _NO_TURN, np.array([3.0, 1.0, -5.0, 0.2, -0.4, 1.3]))),
        symbol("a", 0): ("vector2", np.array([0.4, -0.2])),
        symbol("a", 1): ("vector3", np.array([0.1, 0.3, 0.5])),
        symbol("d", 0): ("vector1", np.array([0.25])),
        symbol("d", 1): ("vector1", np.array([-0.2])),
    }


def calibration_steps(seed: int, steps: int = 8, noise: float = 0.03, loss: str = "") -> Iterator[Batch]:
    """Poses, and points that are measured, come without values; what is to be found out comes with rough ones."""
    rng, hidden = np.random.default_rng(seed), true_calibration()
    truth = {key: value for key, (_, value) in hidden.items()}

    def new(kind: str, letter: str, index: int, value: np.ndarray, given: bool = False) -> Variables:
        truth[symbol(letter, index)] = value
        return Variables(kind, np.array([symbol(letter, index)]), value[None] + 0.1 if given else None)

    def rough(kind: str, key: int) -> tuple[Variables, Factors]:
        dim = TANGENT[kind]
        value, upper = (
            boxplus(kind, truth[key], rng.normal(0, 0.03, dim))[None],
            np.eye(dim)[np.triu_indices(dim)][None],
        )
        if kind.startswith("vector"):
            z = np.concatenate([value, np.eye(dim).reshape(1, -1), np.zeros((1, dim))], axis=1)
            return Variables(kind, np.array([key]), value), Factors(f"linear_{dim}_{kind}", np.array([[key]]), z, upper)
        return Variables(kind, np.array([key]), value), Factors(f"prior_{kind}", np.array([[key]]), value, upper)

    def made(kind: str, *keys: int) -> Factors:
        ends = [truth[key] for key in keys]
        z = (
            residual(kind, ends, np.zeros(3 if "se3" in kind else 2)) + noise * rng.normal(size=FACTOR_KINDS[kind].dim)
            if (kind.startswith("velocity"))
            else random_derived(kind, ends, noise, rng)
        )
        group = Factors(kind, np.array([keys]), z[None], random_information(FACTOR_KINDS[kind].dim, rng)[None])
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    def seen(pose: int, point: int, offset: int) -> Factors:
        """A pixel of a camera that moves little, so that the point stays before it."""
        twist = np.array([0.5, 0.2, 0.1, 0.05, -0.1, 0.1])
        z = random_derived("point_seen_offset", [truth[k] for k in (pose, point, offset)], noise, rng, twist)
        upper = random_information(2, rng)[None] * _PIXEL**2
        group = Factors("point_seen_offset", np.array([[pose, point, offset]]), z[None], upper)
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    b, s, f, a, d = (symbol(letter, 0) for letter in "bsfad")
    for n in range(steps):
        x, y, l, p, u, v = (symbol(letter, n) for letter in "xylpuv")
        plane, space = np.zeros(3), _NO_TURN
        if n:
            plane = boxplus("se2", truth[x - 1], np.array([1.0, 0.1, rng.normal(0, 0.6)]))
            space = boxplus("se3", truth[y - 1], np.array([1, 0, 0.1, *rng.normal(0, 0.3, 3)]))
        ahead = boxplus("se3", space, np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(3, 5), 0, 0, 0]))[:3]
        variables = [new("se2", "x", n, plane), new("se3", "y", n, space)]
        variables += [new("point2", "l", n, plane[:2] + rng.uniform(1, 3, 2)), new("point3", "p", n, ahead)]
        variables += [new("vector2", "u", n, random_value("vector2", rng), given=True)]
        variables += [new("vector3", "v", n, random_value("vector3", rng), given=True)]
        factors: list[Factors] = []
        if n == 0:
            for key, (kind, _) in hidden.items():
                group, prior = rough(kind, key)
                variables.append(group)
                factors.append(prior)
            factors += [factor("prior_se2", [x], truth, noise, rng), factor("prior_se3", [y], truth, noise, rng)]
        else:
            factors += [made("between_se2_scale", x - 1, x, s), made("between_se3_scale", y, y - 1, s + 1)]
            factors += [factor("between_se2", [x - 1, x], truth, noise, rng)]
            factors += [factor("between_se3", [y - 1, y], truth, noise, rng)]
            factors += [made("range_between_se2_bias", x, x - 1, b), made("range_between_se3_bias", y - 1, y, b + 1)]
            factors += [made("range_se2_bias", x, l - 1, b), made("range_se3_bias", y, p - 1, b + 1)]
            factors += [made("bearing_range_se2_offset", x, l - 1, d), made("bearing_se3_offset", y, p - 1, d + 1)]
        factors += [made("landmark_se2_offset", x, l, d), made("landmark_se3_offset", y, p, d + 1)]
        factors += [made("bearing_se2_offset", x, l, d), seen(y, p, d + 1)]
        factors += [made("range_se2_offset", x, l, d), made("range_se3_offset", y, p, d + 1)]
        factors += [made("position_se2_arm", x, a), made("position_se3_arm", y, a + 1)]
        factors += [made("position_se2_frame", x, f), made("position_se3_frame", y, f + 1)]
        factors += [made("velocity_frame_se2", f, u), made("velocity_frame_se3", f + 1, v)]
        if n % 2:
            factors += [made("position_se2_frame_arm", x, f, a), made("position_se3_frame_arm", y, f + 1, a + 1)]
            factors += [made("position_se2_offset", x, d), made("position_se3_offset", y, d + 1)]
            factors += [made("position_se2_frame_offset", x, f, d), made("position_se3_frame_offset", y, f + 1, d + 1)]
        yield Batch(tuple(variables), tuple(factors))
