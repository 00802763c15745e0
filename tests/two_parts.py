"""Two robots in one map, each in a frame of its own, and candidates between them as `attach` takes them."""

from typing import NamedTuple

import numpy as np
from two_maps import SEEN, Candidate, Drive, two_drives

from factorbus.client import Draft, Map

SIGMAS = SEEN["se2"].tolist()


class Parts(NamedTuple):
    """one: letter x; other: letter y."""

    one: Drive
    other: Drive
    candidates: list[Candidate]

    def draft(self) -> Draft:
        """All candidates."""
        return drafted("se2", self.candidates)

    def fill(self, into: Map) -> None:
        """Both parts are in the map."""
        fill(into, self.one)
        fill(into, self.other, "y")

    def lines(self) -> str:
        """The candidates as `factorbus change attach` reads them."""
        return "\n".join(f"x{c.a} y{c.b} {','.join(map(str, c.z))}" for c in self.candidates)


def parts(seed: int, right: int, wrong: int) -> Parts:
    """In the plane."""
    return Parts(*drives("se2", seed, right, wrong))


def drives(kind: str, seed: int, right: int, wrong: int, grouped: int = 0) -> tuple[Drive, Drive, list[Candidate]]:
    return two_drives(kind, 60, (right, wrong), grouped, np.random.default_rng(seed))


def drafted(kind: str, candidates: list[Candidate]) -> Draft:
    draft = Draft()
    for each in candidates:
        draft.factor(f"between_{kind}", [f"x{each.a}", f"y{each.b}"], each.z, sigmas=SEEN[kind].tolist())
    return draft


def fill(into: Map, of: Drive, letter: str = "x") -> None:
    for step in of.steps:
        batch = step.batch()
        names = {ord("x"): ord(letter)}
        into.send(
            batch._replace(
                variables=tuple(g._replace(keys=_renamed(g.keys, names)) for g in batch.variables),
                factors=tuple(g._replace(keys=_renamed(g.keys, names)) for g in batch.factors),
            )
        )
    into.flush()


def between_parts(hall: Map) -> int:
    """How many factors join two letters."""
    return sum(int((np.ptp(g.keys >> 56, axis=1) > 0).sum()) for g in hall.graph().batch.factors)


def _renamed(keys: np.ndarray, names: dict[int, int]) -> np.ndarray:
    letters = np.array([names[letter] for letter in (keys >> 56).ravel().tolist()]).reshape(keys.shape)
    return keys & (1 << 56) - 1 | letters << 56
