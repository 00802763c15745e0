"""Which update of R a step makes, and why: the heuristic of Algorithm 1 of the 2013 paper.  MATH §8.1."""

from dataclasses import dataclass

from factorbus.solver.inc_l.block_factor import Reach
from factorbus.solver.options import Options
from factorbus.wording import counted

_FEW_ROWS = 40
# An Ω-update costs as much as Ω has rows, a Λ-update does not: with more factors than these the latter is for it.
_FEW_FACTORS = 24


@dataclass(frozen=True, slots=True)
class Plan:
    """strategy: "omega", "lambda", "full" or "all-batch"; because: for a person; rows: block rows of R updated."""

    strategy: str
    because: str
    rows: int = 0


def choose(reach: Reach, factors: int, columns: int, options: Options) -> Plan:
    """The update for what that many new factors reach in R, which has `columns` block columns."""
    size, share = int(reach.rows.size), _FEW_ROWS + options.tuning.loop_threshold_share * columns
    small, big = min(options.tuning.small_loop_threshold, share), min(options.tuning.big_loop_threshold, share)
    loop = f"a loop over {reach.span} of {counted(columns, 'block column')} that reaches {size}"
    if size <= small and factors <= _FEW_FACTORS:
        return Plan("omega", f"{loop}, no more than smallLoopThresh = {small:.0f}", size)
    if size <= big:
        many = f", by {factors} factors at once" if size <= small else ""
        return Plan("lambda", f"{loop}{many}, no more than bigLoopThresh = {big:.0f}", size)
    return Plan("full", f"{loop}, more than bigLoopThresh = {big:.0f}")
