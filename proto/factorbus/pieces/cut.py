"""A quadratic form over variables of any kinds as linear factors of one and of two.  `service/MATH.md` §3.8.

A form eᵀ Λ e − 2 ηᵀ e + c with e = x ⊟ y is a sum of linear factors, exactly: one on each pair with the right cross
term, which says too much on the diagonal, and on each variable one that takes this away again.  The latter's Ω is
negative definite; by itself it means nothing.  Of one variable or two there is no need of that.
"""

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MOST = 128  # variables of one form: it has n²/2 pieces
# Scalars in the tangent of each kind of variable, in the order in which a factor of two kinds names them.
_DIM = {"se2": 3, "se3": 6, "point2": 2, "point3": 3, "idp": 6}
_ORDER = list(_DIM)
_PLANE = {"se2", "point2"}
# A cross term below this share of what its variables know by themselves is rounding.
_NOTHING = 1e-15


class Pieces(NamedTuple):
    """Linear factors of one kind: keys (m, arity), measured (m, size), information (m, triangle)."""

    kind: str
    keys: I64
    measured: F64
    information: F64


def tangent_dims(kinds: Sequence[str]) -> list[int]:
    """Scalars of each variable.  Raises ValueError: no such kind, or some of the plane and some of space."""
    for kind in kinds:
        if kind not in _DIM:
            raise ValueError(f"{kind!r} is no kind of variable; wanted {', '.join(_DIM)}")
    if 0 < sum(kind in _PLANE for kind in kinds) < len(kinds):
        raise ValueError(f"{', '.join(kinds)}: wanted all of the plane (se2, point2), or all of space")
    return [_DIM[kind] for kind in kinds]


def as_pieces(
    kinds: Sequence[str], keys: I64, y: Sequence[F64], H: F64, b: F64, whole: tuple[F64, F64] | None = None
) -> list[Pieces]:
    """|H e + b|² with H (m, Σ d) and b (m,): in one piece where it can be, else in as few as it takes.

    whole: Λ = HᵀH and η = −Hᵀb, if they are at hand.
    """
    if len(kinds) > 2:
        information, eta = whole or (H.T @ H, -H.T @ b)
        return cut(kinds, keys, y, information, eta, float(b @ b))
    dims = tangent_dims(kinds)
    first, *others = order = sorted(range(len(kinds)), key=lambda n: (dims[n], _ORDER.index(kinds[n])))
    blocks = np.split(H, np.cumsum(dims)[:-1], axis=1)
    rows = dims[first]
    if len(b) <= rows:
        return [_factor(kinds, keys, y, blocks, b, order, rows)]
    # Rotated so that all but the first rows are of the other variable alone, and the last one of none.
    R = np.linalg.qr(np.column_stack([*(blocks[n] for n in order), b]), mode="r")
    *blocks, rest = np.split(R, np.cumsum([dims[n] for n in order]), axis=1)
    b, of_order = rest[:, 0], ([kinds[n] for n in order], keys[order], [y[n] for n in order])
    made = [_factor(*of_order, [block[:rows] for block in blocks], b[:rows], list(range(len(order))), rows)]
    for n in others:
        alone = ([kinds[n]], keys[[n]], [y[n]])
        H, left, d = blocks[1][rows : rows + dims[n]], b[rows : rows + dims[n]], dims[n]
        if H.any() or left.any():
            made.append(_factor(*alone, [H], left, [0], d))
        rows += d
    if len(b) > rows and b[rows]:
        nothing = np.zeros((1, dims[first]))
        made.append(_factor(kinds[first : first + 1], keys[[first]], [y[first]], [nothing], b[rows:], [0], dims[first]))
    return made


def cut(
    kinds: Sequence[str], keys: I64, y: Sequence[F64], information: F64, eta: F64, constant: float | None = None
) -> list[Pieces]:
    """The pieces of a form over variables of any kinds of one space.  MATH (3.30)-(3.33).

    keys (n,), y: their values, Λ (Σ d, Σ d), positive semidefinite to rounding, η (Σ d,) in its range
    constant: c; None: such that the least value is 0
    They come in this order: a number (a factor with H = 0), those of negative weight, the others of one variable, those
    of two.  Sent so, they are distinguished from what is known of the same variables otherwise.
    """
    n, dims = keys.size, np.array(tangent_dims(kinds))
    start = np.cumsum(dims) - dims
    D = np.sqrt(np.maximum(information.diagonal(), 0.0))
    inverse = np.where(D > 0.0, 1.0 / np.where(D > 0.0, D, 1.0), 0.0)
    # 1. Without units, and without what rounding has made negative.
    S, most, least = _normalized(information, eta, inverse)
    of_kind = {kind: np.array([v for v in range(n) if kinds[v] == kind]) for kind in _ORDER if kind in kinds}
    places = {kind: start[of, None] + np.arange(_DIM[kind]) for kind, of in of_kind.items()}
    taken = {kind: np.zeros((len(of), _DIM[kind], _DIM[kind])) for kind, of in of_kind.items()}
    # 2. A pair has its cross term, and on the diagonal the least that such a pair can have.
    pairs = []
    for a, b in combinations_with_replacement(of_kind, 2):
        first, second = _pairs(len(of_kind[a]), len(of_kind[b]), a == b)
        U, s, Vt = np.linalg.svd(S[places[a][first][:, :, None], places[b][second][:, None, :]], full_matrices=False)
        some = s[:, 0] > _NOTHING
        if not some.any():
            continue
        first, second, root = first[some], second[some], np.sqrt(s[some])
        A, B = root[:, :, None] * U[some].transpose(0, 2, 1), root[:, :, None] * Vt[some]
        np.add.at(taken[a], first, A.transpose(0, 2, 1) @ A)
        np.add.at(taken[b], second, B.transpose(0, 2, 1) @ B)
        i, j = of_kind[a][first], of_kind[b][second]
        A, B = A * D[places[a][first]][:, None, :], B * D[places[b][second]][:, None, :]
        columns = [_values(y, i), _values(y, j), A, B, np.zeros((len(i), A.shape[1]))]
        kind = f"linear_pair_{a}" if a == b else f"linear_pair_{a}_{b}"
        pairs.append(_pieces(kind, np.stack([keys[i], keys[j]], axis=1), columns))
    # 3. A variable has what moves it, with more weight than all together; what is too much goes by a factor of Ω = −I.
    weight, sure, excess, told = math.sqrt(most + 1.0), [], [], 0.0
    for kind, of in of_kind.items():
        at, d = places[kind], _DIM[kind]
        diagonal = S[at[:, :, None], at[:, None, :]]
        G = np.linalg.cholesky((most + 1.0) * np.eye(d) - diagonal + taken[kind]).transpose(0, 2, 1) * D[at][:, None, :]
        b = -inverse[at] * eta[at] / weight
        told += float((b * b).sum())
        columns = [_values(y, of), G, np.zeros((len(of), d))]
        excess.append(_pieces(f"linear_{kind}", keys[of, None], columns, -1.0))
        sure.append(_pieces(f"linear_{kind}", keys[of, None], [columns[0], weight * D[at][:, :, None] * np.eye(d), b]))
    # 4. What is left is a number.
    d = int(dims[0])
    rest = np.zeros((1, d))
    rest[0, 0] = math.sqrt(max((least if constant is None else constant) - told, 0.0))
    number = _pieces(f"linear_{kinds[0]}", keys[:1, None], [_values(y, np.array([0])), np.zeros((1, d, d)), rest])
    return _together([number, *excess, *reversed(sure), *pairs])


def _together(pieces: Sequence[Pieces]) -> list[Pieces]:
    """Those of a kind that follow each other as one: the number of groups of an insert is limited."""
    made: list[Pieces] = []
    for each in pieces:
        if made and made[-1].kind == each.kind:
            last = made.pop()
            keys, measured = np.concatenate([last.keys, each.keys]), np.concatenate([last.measured, each.measured])
            made.append(Pieces(each.kind, keys, measured, np.concatenate([last.information, each.information])))
        else:
            made.append(each)
    return made


def _pairs(a: int, b: int, same: bool) -> tuple[I64, I64]:
    """Of a variables of one kind with b of another; or of each two of one kind."""
    if same:
        return np.triu_indices(a, 1)
    first, second = np.indices((a, b)).reshape(2, -1)
    return first, second


def _normalized(information: F64, eta: F64, inverse: F64) -> tuple[F64, float, float]:
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


def _values(y: Sequence[F64], of: I64) -> F64:
    return np.array([y[v] for v in of.tolist()])


def _factor(
    kinds: Sequence[str], keys: I64, y: Sequence[F64], blocks: Sequence[F64], b: F64, ends: Sequence[int], rows: int
) -> Pieces:
    """One factor of one variable or two, with rows of zeros up to as many as it has."""
    ends = sorted(ends, key=lambda n: _ORDER.index(kinds[n]))
    names = dict.fromkeys(kinds[n] for n in ends)
    kind = "_".join(["linear", *names] if len(ends) == 1 else ["linear", "pair", *names])
    columns = [*(y[n] for n in ends), *(_filled(blocks[n], rows) for n in ends), _filled(b, rows)]
    return _pieces(kind, keys[ends][None], [column[None] for column in columns])


def _filled(block: F64, rows: int) -> F64:
    return np.concatenate([block, np.zeros((rows - len(block), *block.shape[1:]))])


def _pieces(kind: str, keys: I64, columns: Sequence[F64], sign: float = 1.0) -> Pieces:
    measured = np.concatenate([column.reshape(len(keys), -1) for column in columns], axis=1)
    rows = columns[-1].shape[1]
    upper = sign * np.eye(rows)[np.triu_indices(rows)]
    return Pieces(kind, np.ascontiguousarray(keys), measured, np.tile(upper, (len(keys), 1)))
