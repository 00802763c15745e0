"""What is known of many variables together, in pieces on one or two of them that the kernels know.  MATH §3.8.

`factorbus.pieces` cuts a form up.  Some of its pieces have a negative definite Ω: such a one is taken where the pieces
that it comes with sum to a positive semidefinite form, and nothing may change that.  Which these are:

    told apart     from a number (a factor with H = 0) that is followed by pieces of negative weight, each of another
                   variable, on to the last linear factor of these variables: in this order they are cut
    by connection  of the others, all linear factors that hang together over variables with such a piece
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from factorbus.pieces import MOST
from factorbus.solver import errors
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import losses_of
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE, FACTOR_KINDS
from factorbus.solver.graph.quadratic import quadratic
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import LINEAR, LINEAR_OF_ONE
from factorbus.wording import counted

SINGLE = {name: kind.code for name, kind in FACTOR_KINDS.items() if LINEAR_OF_ONE[kind.code]}
_MOST_TOGETHER, _MOST_PIECES = 2 * MOST, 32768  # variables and factors of one form
# Of what the pieces say on the diagonal: a sum of them that is more negative than that is so by more than rounding.
_ROUNDING = 1e-10
# Of each kind: numbers of its measurement; where its H begins, and how many numbers that has.
_SIZE, _H, _H_SIZE = (np.zeros(1 + at.MEMBER, np.int64) for _ in range(3))
for _code, _kind in FACTOR_KIND_OF_CODE.items():
    _SIZE[_code], _H[_code] = _kind.size, sum(end.size for end in _kind.connects)
    _H_SIZE[_code] = _kind.dim * sum(end.dim for end in _kind.connects)


@dataclass(frozen=True, slots=True)
class Joint:
    """Variables (indices), and the rows of all linear factors among them that are one form, both ascending.

    apart: it is told apart by its order
    """

    variables: list[int]
    rows: list[int]
    apart: bool = False


def negative_rows(graph: FactorGraph, first: int = 0) -> I64:
    """Rows from `first` on of the factors with a negative definite Ω."""
    fac = graph.fac[first : graph.counts[at.FACTORS]]
    kind = fac[:, at.F_KIND]
    rows = np.flatnonzero(LINEAR_OF_ONE[kind])
    return first + rows[graph.payload[fac[rows, at.F_AT] + _SIZE[kind[rows]]] < 0.0]


def find_joints(graph: FactorGraph, kept: np.ndarray | None = None) -> list[Joint]:
    """The forms that are there in pieces.  kept (m,): factors that count."""
    of, negative = _linear(graph)
    if kept is not None:
        negative &= kept
        of &= kept
    if not negative.any():
        return []
    joints = list(_told_apart(graph, of, negative))
    for joint in joints:
        of[joint.rows] = negative[joint.rows] = False
    if negative.any():
        joints += _connected(graph.fac[: of.size], of, negative)
    return joints


def find_apart(graph: FactorGraph) -> list[list[int]]:
    """The rows of each form that is told apart by the order of its pieces."""
    of, negative = _linear(graph)
    return [joint.rows for joint in _told_apart(graph, of, negative)]


def check_kept(graph: FactorGraph, kept: np.ndarray, all_or_none: bool = False) -> None:
    """No form loses a piece of negative weight, or its number, and keeps others; with `all_or_none` none at all.

    Raises Apart.
    """
    if kept.all():
        return
    _, negative = _linear(graph)
    for joint in find_joints(graph):
        rows = np.array(joint.rows)
        bound = negative[rows] | all_or_none
        bound[0] |= joint.apart
        if kept[rows].any() and not kept[rows[bound]].all():
            keys = [int(graph.keys[v]) for v in joint.variables]
            raise errors.Apart(keys, graph.ids_of(rows).tolist(), "some would go and others stay")


def check_joints(graph: FactorGraph, first: int = 0) -> None:
    """Every form that has a factor from row `first` on is one.  Raises Apart."""
    of, negative = _linear(graph, first)
    if (bad := np.flatnonzero(negative & ~of)).size:
        row = first + bad[:1]
        key = int(graph.keys[graph.fac[row[0], at.F_I]])
        raise errors.Apart([key], graph.ids_of(row).tolist(), "a loss on a piece of negative weight")
    joints = list(_told_apart(graph, of, negative, first))
    for joint in joints:
        negative[np.array(joint.rows) - first] = False
    if negative.any():  # what is told by what it hangs together with may hang together with what was there
        joints = [joint for joint in find_joints(graph) if joint.rows[-1] >= first]
    for joint in joints:
        keys = [int(graph.keys[v]) for v in joint.variables]
        ids = graph.ids_of(np.array(joint.rows)).tolist()
        if len(keys) > _MOST_TOGETHER or len(ids) > _MOST_PIECES:
            many = (
                f"{len(ids)} on {counted(len(keys), 'variable')} hang together, {_MOST_PIECES} on {_MOST_TOGETHER} may"
            )
            raise errors.Apart(keys[:_MOST_TOGETHER], ids[:_MOST_PIECES], many)
        form = quadratic(graph, joint.rows, [])
        scale = np.where(form.plus > 0.0, 1.0 / np.sqrt(np.where(form.plus > 0.0, form.plus, 1.0)), 1.0)
        share = form.information * scale * scale[:, None]
        if not _is_semidefinite(share):
            lowest = np.linalg.eigvalsh(share).min(initial=0.0) if np.isfinite(share).all() else np.nan
            raise errors.Apart(keys, ids, f"their sum has the eigenvalue {lowest:.3g} (of the share of their diagonal)")


def _is_semidefinite(share: F64) -> bool:
    try:
        np.linalg.cholesky(share + _ROUNDING * np.eye(len(share)))
    except np.linalg.LinAlgError:
        return False
    return True


def _linear(graph: FactorGraph, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Of the factors from row `first` on, which are linear ones without a loss, and which are of negative weight."""
    fac = graph.fac[first : graph.counts[at.FACTORS]]
    negative = np.zeros(len(fac), bool)
    negative[negative_rows(graph, first) - first] = True
    return LINEAR[fac[:, at.F_KIND]] & (losses_of(fac) == at.NO_LOSS), negative


def _told_apart(graph: FactorGraph, of: np.ndarray, negative: np.ndarray, first: int = 0) -> Iterator[Joint]:
    """The forms that begin with a number, among the linear factors `of` (m,) from row `first` on."""
    fac, count = graph.fac[first : first + of.size], of.size
    inside = np.zeros(int(graph.counts[at.VARIABLES]) + 1, bool)
    inside[-1] = True  # of no variable
    before = np.flatnonzero(of[:-1] & ~negative[:-1] & negative[1:])
    heads = [f for f in before.tolist() if _is_number(graph, first + f)]
    ends = np.flatnonzero(~of)
    for f, next_head in pairwise([*heads, count]):
        outside = np.searchsorted(ends, f)
        end = min(next_head, int(ends[outside]) if outside < ends.size else count)
        begin = f + 1 + int(np.argmin(np.append(negative[f + 1 : end], False)))
        variables = np.unique(fac[f + 1 : begin, at.F_I])
        if variables.size < begin - f - 1:
            continue  # a variable has two
        inside[variables] = True
        here = inside[fac[begin:end, at.F_I : at.F_J + 1]].all(axis=1) & ~negative[begin:end]
        last = begin + int(np.argmin(np.append(here, False)))
        if inside[fac[f, at.F_I]]:
            yield Joint(variables.tolist(), list(range(first + f, first + last)), True)
        inside[variables] = False


def _is_number(graph: FactorGraph, f: int) -> bool:
    """Whether a linear factor says nothing of its variable: H = 0."""
    kind, start = graph.fac[f, at.F_KIND], graph.fac[f, at.F_AT]
    begin = start + _H[kind]
    return bool(LINEAR_OF_ONE[kind]) and not graph.payload[begin : begin + _H_SIZE[kind]].any()


def _connected(fac: I64, of: np.ndarray, negative: np.ndarray) -> list[Joint]:
    """Of the linear factors `of` (m,) those over variables with a negative one, apart where no variable joins them."""
    inside = np.zeros(int(fac[:, at.F_I : at.F_J + 1].max()) + 2, bool)  # the last is that of no variable
    inside[fac[negative, at.F_I]] = inside[-1] = True
    rows = np.flatnonzero(of & inside[fac[:, at.F_I]] & inside[fac[:, at.F_J]])
    above: dict[int, int] = {}

    def root(v: int) -> int:
        while above.setdefault(v, v) != v:
            above[v] = above[above[v]]
            v = above[v]
        return v

    ends = fac[rows, at.F_I : at.F_J + 1].tolist()
    for i, j in ends:
        if j >= 0:
            above[root(i)] = root(j)
    joints: dict[int, Joint] = {}
    for f, (i, _) in zip(rows.tolist(), ends, strict=True):
        joints.setdefault(root(i), Joint([], [])).rows.append(f)
    for v in sorted(above):
        joints[root(v)].variables.append(v)
    return list(joints.values())
