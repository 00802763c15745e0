"""A graph after changes that are no additions: what stays is packed anew, in the order it had, ids and all.

Nothing of the old graph is touched, so a change that turns out to be impossible has happened nowhere.
"""

import numpy as np

from factorbus.solver.changes.requested import Edits
from factorbus.solver.graph.arenas import slots_of
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, with_losses
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.graph.key_table import enter_keys
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

_SIZE = np.array([VARIABLE_KIND_OF_CODE[code].size for code in sorted(VARIABLE_KIND_OF_CODE)], np.int64)
_DIM = np.array([VARIABLE_KIND_OF_CODE[code].dim for code in sorted(VARIABLE_KIND_OF_CODE)], np.int64)


def edited(graph: FactorGraph, edits: Edits) -> FactorGraph:
    """`graph` with `edits` made; its factors keep their ids."""
    stays, kept = np.flatnonzero(edits.stays), np.flatnonzero(edits.kept)
    made = FactorGraph()
    made.keys, made.var, made.fac = graph.keys[stays], graph.var[stays], graph.fac[kept]
    made.stamps = graph.stamps[stays]
    _pack_values(edits.values, made)
    columns = _number_columns(made, edits.free[stays])
    _pack_payload(graph, made, kept, edits)
    _renumber_ends(made, edits)
    made.table = np.zeros(slots_of(stays.size), np.int64)
    enter_keys(stays.size, made.table, made.keys)
    made.counts[[at.VARIABLES, at.FACTORS, at.VALUES]] = stays.size, kept.size, made.values.size
    made.counts[[at.PAYLOAD, at.COLUMNS, at.SCALARS]] = made.payload.size, columns, made.dims[:columns].sum()
    made.counts[at.MEMBERS] = np.count_nonzero(~is_first(made.fac))
    made.counts[at.STAMPED] = np.count_nonzero(made.stamps != at.NO_STAMP)
    made.name_factors(graph.ids_of(kept), graph.next_id)
    made.own = graph.own
    return made


def _pack_values(values: F64, made: FactorGraph) -> None:
    """The values one after the other; V_AT follows."""
    sizes = _SIZE[made.var[:, at.V_KIND]]
    start = _starts(sizes)
    made.values = np.empty(int(sizes.sum()))
    _copy(values, made.var[:, at.V_AT], sizes, made.values, start)
    made.var[:, at.V_AT] = start


def _number_columns(made: FactorGraph, free: np.ndarray) -> int:
    """Block columns and scalars for the free variables, in their order; gives how many."""
    var, dims = made.var, _DIM[made.var[:, at.V_KIND]]
    var[:, at.V_COLUMN] = np.where(free, np.cumsum(free) - 1, -1)
    var[:, at.V_SCALAR] = np.where(free, _starts(np.where(free, dims, 0)), -1)
    var[:, at.V_DIAGONAL] = -1
    columns = int(np.count_nonzero(free))
    made.dims = np.zeros(len(var), np.int64)
    made.dims[:columns] = dims[free]
    return columns


def _pack_payload(graph: FactorGraph, made: FactorGraph, kept: I64, edits: Edits) -> None:
    """Measurements, information times its weight, and scales, of the rows `kept`; F_AT and F_FLAGS follow."""
    fac, loss, scale, weight = made.fac, edits.loss[kept], edits.scale[kept], edits.weight[kept]
    measured, triangle = graph.sizes_of(kept)
    sizes, robust = measured + triangle, np.flatnonzero(loss != at.NO_LOSS)
    start = _starts(sizes + (loss != at.NO_LOSS))
    made.payload = np.empty(int(sizes.sum()) + robust.size)
    _copy(graph.payload, fac[:, at.F_AT], sizes, made.payload, start)
    made.payload[start[robust] + sizes[robust]] = scale[robust]
    for row in np.flatnonzero(weight != 1.0).tolist():
        begin = start[row] + measured[row]
        made.payload[begin : begin + triangle[row]] *= weight[row]
    fac[:, at.F_AT] = start
    fac[:, at.F_FLAGS] = with_losses(fac[:, at.F_FLAGS] & ~at.SWAPPED, loss)


def _renumber_ends(made: FactorGraph, edits: Edits) -> None:
    """The variables have other indices; and no factor has a place in any Λ yet."""
    index = np.cumsum(edits.stays) - 1
    for end in (at.F_I, at.F_J):
        ends = made.fac[:, end]
        made.fac[:, end] = np.where(ends >= 0, index[ends], -1)
    made.fac[:, [at.F_II, at.F_JJ, at.F_IJ]] = -1


def _starts(sizes: I64) -> I64:
    """Where blocks of these sizes begin that follow each other."""
    return np.cumsum(sizes) - sizes


def _copy(source: F64, start: I64, sizes: I64, out: F64, to: I64) -> None:
    """Blocks of these sizes from `start` in `source` to `to` in `out`."""
    along = np.arange(int(sizes.sum())) - np.repeat(_starts(sizes), sizes)
    out[np.repeat(to, sizes) + along] = source[np.repeat(start, sizes) + along]
