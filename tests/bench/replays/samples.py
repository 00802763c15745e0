"""The steps of a replay at which the quality of an estimate is looked at."""

import math
from dataclasses import asdict, dataclass

_GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, slots=True)
class Sampling:
    """every: each step that is a multiple of it; 0: `most` steps, spread.  The last step always."""

    most: int = 100
    every: int = 0

    def steps(self, count: int) -> tuple[int, ...]:
        """Those of a replay of `count` steps."""
        return regular_steps(count, self.every) if self.every else sample_steps(count, self.most)

    def as_json(self) -> dict[str, int]:
        """For a job's file; `Sampling(**...)` is the way back."""
        return asdict(self)


def sample_steps(steps: int, most: int = 100) -> tuple[int, ...]:
    """At most `most` steps, evenly spread, the last one among them.

    One step is taken from each of equal stretches, at a place in it that goes on by the golden section: a regular
    grid of every hundredth step would always see a solver that optimizes at every tenth or hundredth pose at the
    same moment, right after it has done so.
    """
    if steps <= most:
        return tuple(range(steps))
    if most == 1:
        return (steps - 1,)
    width = (steps - 1) / (most - 1)
    picked = {int(width * (i + (i * _GOLDEN) % 1.0)) for i in range(most - 1)}
    return (*sorted(step for step in picked if step < steps - 1), steps - 1)


def regular_steps(steps: int, every: int) -> tuple[int, ...]:
    """Each `every`-th step and the last one; fair to solvers that do the same at every step."""
    return (*range(every - 1, steps - 1, every), steps - 1)
