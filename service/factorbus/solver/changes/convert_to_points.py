"""Features of inverse depth become points.  MATH §3.3.

A point has half the numbers of a feature, and its observations half the work; it is as good a Gaussian once its depth
is known.  What changes is the form, not the estimate: the point is where the feature stood for, and the same pixels are
measured of it.  What goes is the tie to the anchor and the first guess of the depth, which has done its work by then.
"""

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph.arenas import slots_of
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import losses_of, rows_of_factors
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.graph.key_table import enter_keys
from factorbus.solver.kernels.graph.linearity_index import linearity
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.lenses.layout import LENS_SIZE

_TURNING = "turning features into points"
# Of a first observation's payload: where the lens is, and the pixel's block in the upper triangle of a 6 × 6 matrix.
_LENS = np.arange(3, 4 + LENS_SIZE)
_PIXEL_BLOCK = np.array([15, 16, 18])
# Where the information of its guess of ρ is, and how much surer than the guess (σ) one has to be to do without.
_GUESS, _SURER = 14 + 20, 10.0


def find_convertible(graph: FactorGraph, below: float) -> I64:
    """Keys of the features whose linearity index (3.19) is below this: as points they are as good Gaussians.

    One whose first guess of the depth still says something is left: as a point it would lose that, and a map its scale.
    """
    count = int(graph.counts[at.VARIABLES])
    found = np.empty(count)
    linearity(count, int(graph.counts[at.FACTORS]), graph.var, graph.fac, graph.values, graph.payload, found)
    firsts = graph.fac[: graph.counts[at.FACTORS]]
    firsts = firsts[firsts[:, at.F_KIND] == at.IDP_FIRST]
    features = firsts[:, at.F_J]
    guessed = 1.0 / np.sqrt(graph.payload[firsts[:, at.F_AT] + _GUESS])
    known = found[features] * np.abs(graph.values[graph.var[features, at.V_AT] + 5]) / 4.0
    found[features[guessed < _SURER * known]] = np.inf
    found[has_linear_factor(graph)] = np.inf
    return graph.keys[np.flatnonzero(found < below)]


def pick_features(graph: FactorGraph, keys: I64) -> I64:
    """These features as variables.  Raises UnknownVariable; KindMismatch for what is none, or has to stay one."""
    picked = np.array([graph.find(key) for key in keys.tolist()], np.int64)
    for key, v in zip(keys.tolist(), picked.tolist(), strict=True):
        if v < 0:
            raise errors.UnknownVariable(key, _TURNING)
        if (kind := int(graph.var[v, at.V_KIND])) != at.IDP:
            raise errors.KindMismatch(key, _TURNING, VARIABLE_KIND_OF_CODE[kind].name, "idp")
        if has_linear_factor(graph)[v]:
            raise errors.KindMismatch(key, _TURNING, "idp with a linear factor", "idp that cameras see")
    return picked


def has_linear_factor(graph: FactorGraph) -> np.ndarray:
    """Which variables (n,) a linear factor, or one of an own kind, is on: such a feature stays what that is of."""
    fac, marked = graph.fac[: graph.counts[at.FACTORS]], np.zeros(int(graph.counts[at.VARIABLES]) + 1, bool)
    linear = np.flatnonzero(np.isin(fac[:, at.F_KIND], (at.LINEAR, at.OWN)))
    marked[fac[rows_of_factors(fac, linear), at.F_I : at.F_J + 1]] = True
    return marked[:-1]


def with_points(graph: FactorGraph, features: I64) -> FactorGraph:
    """A graph in which these features are points, under their keys; all else is the same, factor ids included."""
    made = FactorGraph()
    variables, factors = int(graph.counts[at.VARIABLES]), int(graph.counts[at.FACTORS])
    var, fac = graph.var[:variables].copy(), graph.fac[:factors].copy()
    turned = np.zeros(variables, bool)
    turned[features] = True
    values = _values(graph, var, turned)
    payload = _payload(graph, fac, turned)
    free = var[:, at.V_COLUMN] >= 0
    var[turned, at.V_KIND] = at.POINT3
    dims = np.array([VARIABLE_KIND_OF_CODE[code].dim for code in var[:, at.V_KIND].tolist()], np.int64)
    var[free, at.V_SCALAR] = np.cumsum(dims[free]) - dims[free]
    var[:, at.V_DIAGONAL] = -1
    fac[:, [at.F_II, at.F_JJ, at.F_IJ]] = -1
    made.keys, made.var, made.values, made.fac, made.payload = graph.keys[:variables].copy(), var, values, fac, payload
    made.dims = np.zeros(variables, np.int64)
    made.dims[: np.count_nonzero(free)] = dims[free]
    made.table = np.zeros(slots_of(variables), np.int64)
    enter_keys(variables, made.table, made.keys)
    made.counts[[at.VARIABLES, at.FACTORS, at.VALUES]] = variables, factors, values.size
    made.counts[at.MEMBERS] = graph.counts[at.MEMBERS]
    made.counts[[at.PAYLOAD, at.COLUMNS, at.SCALARS]] = payload.size, np.count_nonzero(free), dims[free].sum()
    made.stamps, made.counts[at.STAMPED] = graph.stamps[:variables].copy(), graph.counts[at.STAMPED]
    made.ids, made.id_shift, made.own = graph.ids, graph.id_shift, graph.own
    return made


def _values(graph: FactorGraph, var: I64, turned: I64) -> F64:
    """The values, packed anew; V_AT of `var` follows."""
    pieces, at_new = [], 0
    for row, is_turned in zip(var, turned, strict=True):
        size = VARIABLE_KIND_OF_CODE[int(row[at.V_KIND])].size
        value = graph.values[row[at.V_AT] : row[at.V_AT] + size]
        pieces.append(_point(value) if is_turned else value)
        row[at.V_AT] = at_new
        at_new += pieces[-1].size
    return np.concatenate([*pieces, np.empty(0)])


def _point(y: F64) -> F64:
    """(x, y, z) + m/ρ."""
    m = np.array([np.cos(y[4]) * np.sin(y[3]), -np.sin(y[4]), np.cos(y[4]) * np.cos(y[3])])
    return y[:3] + m / y[5]


def _payload(graph: FactorGraph, fac: I64, turned: I64) -> F64:
    """The payloads, packed anew; F_KIND and F_AT of `fac` follow."""
    pieces, at_new = [], 0
    for f, row in enumerate(fac):
        if row[at.F_KIND] == at.MEMBER:
            continue
        kind, p = graph.kind_of(f), int(row[at.F_AT])
        has_loss = losses_of(row) != at.NO_LOSS
        numbers = graph.payload[p : p + kind.width + has_loss]
        if row[at.F_J] >= 0 and turned[row[at.F_J]]:
            if kind.code == at.IDP_FIRST:
                scale = numbers[kind.width :]
                numbers = np.concatenate([numbers[:2], numbers[_LENS], numbers[kind.size + _PIXEL_BLOCK], scale])
            row[at.F_KIND] = at.POINT_SEEN
        pieces.append(numbers)
        row[at.F_AT] = at_new
        at_new += numbers.size
    return np.concatenate([*pieces, np.empty(0)])
