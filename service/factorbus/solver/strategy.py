"""Which update of R a step makes, and why: the heuristic of Algorithm 1 of the 2013 paper.  MATH §8.1."""

from dataclasses import dataclass

from factorbus.solver.block_factor import Reach


@dataclass(frozen=True, slots=True)
class Plan:
    """strategy: "omega", "lambda", "full" or "all-batch"; because: for a person; rows: block rows of R updated."""

    strategy: str
    because: str
    rows: int = 0


def choose(reach: Reach, small_loop: int, big_loop: int) -> Plan:
    """The update for what the new factors reach in R: smallLoopThresh and bigLoopThresh are in block rows of R."""
    size = int(reach.rows.size)
    loop = f"a loop over {reach.span} block columns that reaches {size}"
    if size <= small_loop:
        return Plan("omega", f"{loop}, no more than small_loop = {small_loop}", size)
    if size <= big_loop:
        return Plan("lambda", f"{loop}, no more than big_loop = {big_loop}", size)
    return Plan("full", f"{loop}, more than big_loop = {big_loop}")
