"""A drive through a town of square blocks: a pose every metre, a turn at some of the crossings."""

import math
from collections.abc import Iterator
from random import Random

HEADINGS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # east, north, west, south: quarters of a turn to the left
_FIRST_LIMIT_M = 20.0  # how far the town reaches at first in each direction ...
_GROWTH = 0.35  # ... and how it grows with the square root of the way: 55 m at 10,000 poses, 370 m at a million

GridPose = tuple[int, int, int]


def walk_streets(chance: Random, block_m: int, straight: float) -> Iterator[GridPose]:
    """Places (x, y, heading) in metres and quarter turns, without end, from (0, 0, 0).

    At a crossing the car goes straight on with that share, else turns left or right, and stays inside the town; it
    turns first and then drives a metre.  What is open of the town grows with the way, so that places are visited
    again and again at the same rate however long the drive is.
    """
    x = y = heading = way = 0
    while True:
        yield x, y, heading
        if x % block_m == 0 and y % block_m == 0:
            limit = _FIRST_LIMIT_M + _GROWTH * math.sqrt(way)
            heading = _next_heading(chance, x, y, heading, block_m, straight, limit)
        dx, dy = HEADINGS[heading]
        x, y, way = x + dx, y + dy, way + 1


def _next_heading(chance: Random, x: int, y: int, heading: int, block_m: int, straight: float, limit: float) -> int:
    luck = chance.random()
    side = 1 if luck < straight + (1 - straight) / 2 else 3
    turns = (0, side, 4 - side, 2) if luck < straight else (side, 0, 4 - side, 2)
    for turn in turns:
        new = (heading + turn) % 4
        dx, dy = HEADINGS[new]
        if abs(x + dx * block_m) <= limit and abs(y + dy * block_m) <= limit:
            return new
    return (heading + 2) % 4
