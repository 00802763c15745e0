"""The thresholds of a step in what a residual is like in this map.  MATH §9.6."""

import math

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part

LEAST_CHI2 = 1e-2


@inline_kernel
def scale_thresholds(factors: int, scalars: int, tree_settings: F64, state: I64, totals: F64) -> F64:
    """The settings of the tree with their thresholds for a graph with this number of factors and of scalars."""
    unit, scaled = totals[tl.T_UNIT], tree_settings.copy()
    whole = state[tl.S_CONTINUES] != 0 and not tree_settings[tl.P_BUDGET] < math.inf
    per_scalar = unit * math.sqrt(factors / max(scalars, 1))  # (9.17)
    scaled[tl.P_WILDFIRE_THRESHOLD] = 0.0 if whole else scaled[tl.P_WILDFIRE_THRESHOLD] * per_scalar
    scaled[tl.P_RELINEARIZE_THRESHOLD] *= unit
    scaled[tl.P_MAX_ERROR] *= unit
    share = unit * unit * max(factors, 1) * totals[tl.T_COOLDOWN]  # of χ²
    scaled[tl.P_SAME_STEP_SHARE] *= share
    scaled[tl.P_NEXT_STEP_SHARE] *= share
    scaled[tl.P_MAX_WAIT] *= totals[tl.T_COST_RATIO]
    return scaled


@inline_kernel
def note_cooldown(tree_settings: F64, state: I64, totals: F64) -> None:
    """What (9.19) asks for in a step that begins.  It is kept, as a step that found no room goes on with the same: by
    then a round of it may have relinearized, and whether there is room must not matter."""
    cost_ratio = max(state[tl.S_RELINEARIZING] / tree_settings[tl.P_COOLDOWN_FLOPS], 1.0)
    totals[tl.T_COST_RATIO], totals[tl.T_COOLDOWN] = cost_ratio, cooldown_share(cost_ratio, tree_settings, state)


@inline_kernel
def residual_unit(factors: int, totals: F64) -> float:
    """What a residual is like in this map, in its σ: √(χ² per factor), as far as known.  (9.6)"""
    return math.sqrt((max(totals[tl.T_MODEL], 0.0) + LEAST_CHI2) / max(factors, 1))


@part
def rescale(factors: int, scalars: int, tree_settings: F64, state: I64, totals: F64, settings: F64) -> None:
    """The thresholds in what a residual is like without the factors that were taken out, or with their new weights."""
    totals[tl.T_UNIT] = residual_unit(factors, totals)
    scaled = scale_thresholds(factors, scalars, tree_settings, state, totals)
    for each in range(settings.size):
        settings[each] = scaled[each]


@inline_kernel
def cooldown_share(cost_ratio: float, settings: F64, state: I64) -> float:
    """The factor on both shares so soon after the last relinearization.  (9.19)"""
    rested = settings[tl.P_COOLDOWN_STEPS] * cost_ratio / max(state[tl.S_STEP] - state[tl.S_RELINEARIZED_AT], 1)
    return min(max(rested * rested, 1.0), settings[tl.P_COOLDOWN_FACTOR] * math.sqrt(cost_ratio))
