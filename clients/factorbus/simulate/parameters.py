"""What the parameters of a world may be."""

import math

from factorbus.proto.problems import Problem


class BadParameter(Problem):
    """A parameter of a simulated world that makes no sense."""

    code = "bad_parameter"

    def __init__(self, name: str, seen: object, wanted: str) -> None:
        super().__init__(f"{name} is {seen!r}; wanted {wanted}", parameter=name, seen=repr(seen), wanted=wanted)


def checked_run(poses: int, seed: int) -> None:
    """Raise BadParameter unless there is a pose and the seed is a natural number."""
    if poses < 1:
        raise BadParameter("poses", poses, "1 or more")
    if seed < 0:
        raise BadParameter("seed", seed, "0 or more")


def checked_sigma(name: str, sigma: float, most: float = math.inf) -> None:
    """Raise BadParameter unless 0 < sigma <= most."""
    if not 0 < sigma <= most or not math.isfinite(sigma):
        raise BadParameter(
            name, sigma, "a standard deviation above 0" + ("" if most == math.inf else f", up to {most:g}")
        )


def checked_share(name: str, share: float) -> None:
    """Raise BadParameter unless 0 <= share <= 1."""
    if not 0 <= share <= 1:
        raise BadParameter(name, share, "a number from 0 to 1")


def checked_at_least(name: str, value: float, least: float) -> None:
    """Raise BadParameter unless value >= least."""
    if not value >= least or not math.isfinite(value):
        raise BadParameter(name, value, f"{least:g} or more")
