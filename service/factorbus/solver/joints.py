"""What is known of many poses together, in pieces on one pose or two that the kernels know.  MATH §3.8.

A quadratic form over poses, eᵀ Λ e − 2 ηᵀ e + c with e = x ⊟ y, is a sum of linear factors, exactly: one on each pair
with the right cross term, which says too much on the diagonal, and on each pose one that takes this away again.  The
latter's Ω is negative definite.  By itself it means nothing: it is taken where all linear factors that hang together
with it sum to a positive semidefinite form, and nothing may change that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.solver import errors
from factorbus.solver.factors import FACTOR_KIND_OF_CODE
from factorbus.solver.graph import Graph
from factorbus.solver.groups import FactorGroup
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64
from factorbus.solver.quadratic import quadratic

SINGLE = {"linear_se2": at.LINEAR_SE2, "linear_se3": at.LINEAR_SE3}
MOST = 32  # poses of one form that is split
_MOST_TOGETHER, _MOST_PIECES = 4 * MOST, 16384  # poses and factors of several that overlap
# Of what the pieces say on the diagonal: a sum of them that is more negative than that is so by more than rounding.
_ROUNDING = 1e-10
# A cross term below this share of what its poses know by themselves is rounding.
_NOTHING = 1e-15
_SIZE = {code: FACTOR_KIND_OF_CODE[code].size for code in SINGLE.values()}


@dataclass(frozen=True, slots=True)
class Joint:
    """Poses (indices), and the rows of all linear factors among them that are one form."""

    poses: list[int]
    rows: list[int]


def negative_rows(graph: Graph, first: int = 0) -> I64:
    """Rows from `first` on of the factors with a negative definite Ω."""
    fac = graph.fac[first : graph.counts[at.FACTORS]]
    rows = np.flatnonzero((fac[:, at.F_KIND] == at.LINEAR_SE2) | (fac[:, at.F_KIND] == at.LINEAR_SE3))
    size = np.where(fac[rows, at.F_KIND] == at.LINEAR_SE2, _SIZE[at.LINEAR_SE2], _SIZE[at.LINEAR_SE3])
    return first + rows[graph.payload[fac[rows, at.F_AT] + size] < 0.0]


def find_joints(graph: Graph, kept: np.ndarray | None = None) -> list[Joint]:
    """The forms that are there in pieces.  kept (m,): factors that count."""
    negative = negative_rows(graph)
    if kept is not None:
        negative = negative[kept[negative]]
    if not negative.size:
        return []
    fac = graph.fac[: graph.counts[at.FACTORS]]
    inside = np.zeros(int(graph.counts[at.VARIABLES]) + 1, bool)  # the last is that of no variable
    inside[fac[negative, at.F_I]] = True
    single, pair = fac[:, at.F_KIND] >= at.LINEAR_SE2, fac[:, at.F_KIND] >= at.LINEAR_PAIR_SE2
    of = single & inside[fac[:, at.F_I]] & (~pair | inside[fac[:, at.F_J]])
    of &= (fac[:, at.F_FLAGS] >> at.LOSS_SHIFT) == at.NO_LOSS
    if kept is not None:
        of &= kept[: of.size]
    return _connected(fac, np.flatnonzero(of))


def check_kept(graph: Graph, kept: np.ndarray, all_or_none: bool = False) -> None:
    """No form loses a piece of negative weight and keeps others; with `all_or_none` none at all.  Raises Apart."""
    for joint in find_joints(graph):
        rows = np.array(joint.rows)
        negative = np.intersect1d(rows, negative_rows(graph))
        if kept[rows].any() and not kept[rows if all_or_none else negative].all():
            keys = [int(graph.keys[v]) for v in joint.poses]
            raise errors.Apart(keys, graph.ids_of(rows).tolist(), "some would go and others stay")


def check_joints(graph: Graph, first: int = 0) -> None:
    """Every form that has a factor from row `first` on is one.  Raises Apart."""
    negative = negative_rows(graph)
    if not negative.size:
        return
    robust = (graph.fac[: graph.counts[at.FACTORS], at.F_FLAGS] >> at.LOSS_SHIFT) != at.NO_LOSS
    for f in negative.tolist():
        if robust[f]:
            key = int(graph.keys[graph.fac[f, at.F_I]])
            raise errors.Apart([key], graph.ids_of(np.array([f])).tolist(), "a loss on a piece of negative weight")
    for joint in find_joints(graph):
        if joint.rows[-1] < first:
            continue
        keys = [int(graph.keys[v]) for v in joint.poses]
        ids = graph.ids_of(np.array(joint.rows)).tolist()
        if len(keys) > _MOST_TOGETHER or len(ids) > _MOST_PIECES:
            many = f"{len(ids)} on {len(keys)} poses hang together, {_MOST_PIECES} on {_MOST_TOGETHER} may"
            raise errors.Apart(keys[:_MOST_TOGETHER], ids[:_MOST_PIECES], many)
        form = quadratic(graph, joint.rows, [])
        scale = np.where(form.plus > 0.0, 1.0 / np.sqrt(np.where(form.plus > 0.0, form.plus, 1.0)), 1.0)
        lowest = np.linalg.eigvalsh(form.information * scale * scale[:, None]).min(initial=0.0)
        if not lowest >= -_ROUNDING:
            raise errors.Apart(keys, ids, f"their sum has the eigenvalue {lowest:.3g} (of the share of their diagonal)")


def split(kind: str, keys: I64, y: Sequence[F64], information: F64, eta: F64) -> list[FactorGroup]:
    """The pieces of a form over poses of one kind, "se2" or "se3"; its least value is 0.  MATH (3.30)-(3.33).

    keys (n,), y: their values, Λ (n d, n d), positive semidefinite to rounding, η (n d,) in its range.
    """
    n = keys.size
    d, upper = eta.size // n, np.triu_indices(eta.size // n)
    D = np.sqrt(np.maximum(information.diagonal(), 0.0)).reshape(n, d)
    inverse = np.where(D > 0.0, 1.0 / np.where(D > 0.0, D, 1.0), 0.0)
    # 1. Without units, and without what rounding has made negative.
    S, most, least = _normalised(information, eta, inverse.ravel())
    blocks = S.reshape(n, d, n, d).transpose(0, 2, 1, 3)
    # 2. A pair has its cross term, and on the diagonal the least that such a pair can have.
    first, second = np.triu_indices(n, 1)
    U, s, Vt = np.linalg.svd(blocks[first, second])
    some = s[:, 0] > _NOTHING if len(s) else np.zeros(0, bool)
    first, second, U, root, Vt = first[some], second[some], U[some], np.sqrt(s[some]), Vt[some]
    A = root[:, :, None] * U.transpose(0, 2, 1)
    B = root[:, :, None] * Vt
    taken = np.zeros((n, d, d))
    np.add.at(taken, first, A.transpose(0, 2, 1) @ A)
    np.add.at(taken, second, B.transpose(0, 2, 1) @ B)
    # 3. A pose has what moves it, with more weight than all together; what is too much goes by a factor of Ω = −I.
    diagonal = blocks[np.arange(n), np.arange(n)]
    G = np.linalg.cholesky((most + 1.0) * np.eye(d) - diagonal + taken).transpose(0, 2, 1) * D[:, None, :]
    weight = math.sqrt(most + 1.0)
    H = weight * D[:, :, None] * np.eye(d)
    b = -inverse * eta.reshape(n, d) / weight
    values, unit, none = np.array(y), np.eye(d)[upper], np.zeros((n, d))
    ends = np.stack([keys[first], keys[second]], axis=1)
    pairs = [
        values[first],
        values[second],
        A * D[first, None, :],
        B * D[second, None, :],
        none[:1].repeat(len(ends), 0),
    ]
    # 4. What is left is a number.
    rest = np.zeros((1, d))
    rest[0, 0] = math.sqrt(max(least - float((b * b).sum()), 0.0))
    return [
        _factors(f"linear_{kind}", keys[:, None], [values, H, b], unit),
        _factors(f"linear_{kind}", keys[:, None], [values, G, none], -unit),
        _factors(f"linear_{kind}", keys[:1, None], [values[:1], np.zeros((1, d, d)), rest], unit),
        _factors(f"linear_pair_{kind}", ends, pairs, unit),
    ]


def _normalised(information: F64, eta: F64, inverse: F64) -> tuple[F64, float, float]:
    """(S = D⁻¹ Λ D⁻¹ without negative eigenvalues, its largest one, ηᵀ Λ⁺ η)."""
    S = information * inverse * inverse[:, None]
    S = 0.5 * (S + S.T)
    values, V = np.linalg.eigh(S)
    along = V.T @ (inverse * eta)
    known = values > 1e-13 * max(values[-1], 0.0)
    least = float((along[known] ** 2 / values[known]).sum())
    if values[0] < 0.0:
        S = (V * np.maximum(values, 0.0)) @ V.T
        S = 0.5 * (S + S.T)
    return S, max(float(values[-1]), 0.0), least


def _factors(kind: str, keys: I64, columns: Sequence[np.ndarray], upper: F64) -> FactorGroup:
    measured = np.concatenate([column.reshape(len(keys), -1) for column in columns], axis=1)
    return FactorGroup(kind, np.ascontiguousarray(keys), measured, np.tile(upper, (len(keys), 1)))


def _connected(fac: I64, rows: I64) -> list[Joint]:
    """The factors `rows`, apart where no variable joins them."""
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
        joints[root(v)].poses.append(v)
    return list(joints.values())
