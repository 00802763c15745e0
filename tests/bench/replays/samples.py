"""The steps of a replay at which the quality of an estimate is looked at."""

import math

_GOLDEN = (math.sqrt(5) - 1) / 2


def sample_steps(steps: int, most: int = 100) -> tuple[int, ...]:
    """At most `most` steps, evenly spread, the last one among them.

    One step is taken from each of equal stretches, at a place in it that goes on by the golden section: a regular
    grid of every hundredth step would always see a solver that optimises at every tenth or hundredth pose at the
    same moment, right after it has done so.
    """
    if steps <= most:
        return tuple(range(steps))
    width = (steps - 1) / (most - 1)
    picked = {int(width * (i + (i * _GOLDEN) % 1.0)) for i in range(most - 1)}
    return (*sorted(step for step in picked if step < steps - 1), steps - 1)
