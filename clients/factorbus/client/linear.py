"""What a front end has linearized itself, as a linear factor."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, of_type
from factorbus.client.certainty import Certainty, full, loss_of, triangle_of
from factorbus.proto.arrays import F64
from factorbus.proto.kinds import MOST_JOINED, VARIABLE_KINDS, linear_kind
from factorbus.proto.messages import Factors
from factorbus.proto.problems import BadInformation, BadShape, UnknownKind
from factorbus.proto.symbols import format_symbol

_SPACE = (6, 7)  # numbers of an idp and of an se3: what is with them and has three is a point3
_BY_SIZE = {2: "point2", 3: "se2", 6: "idp", 7: "se3"}


def linear_factor(
    keys: Sequence[int],
    values: Sequence[ArrayLike],
    jacobians: Sequence[ArrayLike],
    residual: ArrayLike,
    kinds: Sequence[str],
    certainty: Certainty,
) -> Factors:
    """|Σ H (x ⊟ y) + b|² by Ω; see `Draft.linear`.

    Raises BadShape, UnknownKind, BadInformation, BadOption, NotFiniteNumbers.
    """
    where = " ".join(["linear", *map(format_symbol, keys)])
    for name, given in (("values", values), ("jacobians", jacobians), ("kinds", kinds)):
        of_type(f"{where}: {name}", given, Collection, "one for each key")
    y = [all_finite(where, as_numbers(f"{where}: values", value)) for value in values]
    names = list(kinds)
    if len(names) == len(y) and not all(names):
        names = [name or guess for name, guess in zip(names, _kinds_of(where, y, names), strict=True)]
    b = all_finite(where, as_numbers(f"{where}: residual", residual))
    _check_counts(where, keys, len(y), len(jacobians), len(names))
    dims = _checked_dims(where, names, y)
    if b.ndim != 1 or not b.size:
        raise BadShape(f"{where}: residual", f"shape {b.shape}", "(m,)")
    H = np.column_stack(
        [_block(f"{where}: jacobian of a {n}", J, (b.size, d)) for n, J, d in zip(names, jacobians, dims, strict=True)]
    )
    triangle, (loss, scale) = triangle_of(where, b.size, certainty), loss_of(where, certainty.get("loss"))
    root = _root(where, full(triangle, b.size))
    if b.size > sum(dims) + 1:  # more rows than say anything: a triangle has it all
        H, b = _triangle(root, H, b)
        triangle = np.eye(b.size)[np.triu_indices(b.size)]
    blocks = [block.reshape(-1) for block in np.split(H, np.cumsum(dims)[:-1], axis=1)]
    measured, ends = np.concatenate([*y, *blocks, b])[None], np.array([keys])
    kind = linear_kind(b.size, tuple(names)).name
    return Factors(kind, ends, measured, triangle[None], loss, np.array([scale]) if loss else None)


def _check_counts(where: str, keys: Sequence[int], *counts: int) -> None:
    if not 1 <= len(keys) <= MOST_JOINED:
        raise BadShape("linear: keys", len(keys), f"1 to {MOST_JOINED}")
    if len(set(keys)) < len(keys):
        raise BadShape(f"{where}: keys", "one of them twice", "each once; add up its jacobians")
    for name, count in zip(("values", "jacobians", "kinds"), counts, strict=True):
        if count != len(keys):
            raise BadShape(f"{where}: {name}", count, f"{len(keys)}, one for each key")


def _checked_dims(where: str, names: Sequence[str], y: Sequence[F64]) -> list[int]:
    """Scalars in the tangent of each."""
    for name, value in zip(names, y, strict=True):
        if name not in VARIABLE_KINDS:
            raise UnknownKind("draft", name, tuple(VARIABLE_KINDS))
        if value.shape != (VARIABLE_KINDS[name].size,):
            raise BadShape(f"{where}: value of a {name}", f"shape {value.shape}", f"({VARIABLE_KINDS[name].size},)")
    try:
        linear_kind(1, tuple(names))
    except ValueError as problem:
        wanted = "all of the plane (se2, point2), or all of space (se3, point3, idp)"
        raise BadShape(f"{where}: kinds", ", ".join(names), wanted) from problem
    return [VARIABLE_KINDS[name].dim for name in names]


def _kinds_of(where: str, y: Sequence[F64], names: Sequence[str]) -> list[str]:
    """Of those without a name by how many numbers their values have; of the others "".  names: "" where not known."""
    unnamed = [value for value, name in zip(y, names, strict=True) if not name]
    for value in unnamed:
        if value.ndim != 1 or value.size not in _BY_SIZE:
            wanted = "(3,) of an se2 or point3, (7,) of an se3, (2,) of a point2, (6,) of an idp, or kinds="
            raise BadShape(f"{where}: values", f"shape {value.shape}", wanted)
    space = any(value.size in _SPACE for value in unnamed) or not {"se3", "point3", "idp"}.isdisjoint(names)
    by_size = _BY_SIZE | {3: "point3"} if space else _BY_SIZE
    return ["" if name else by_size[value.size] for value, name in zip(y, names, strict=True)]


def _block(where: str, given: ArrayLike, shape: tuple[int, int]) -> F64:
    block = all_finite(where, as_numbers(where, given))
    if block.shape != shape:
        raise BadShape(where, f"shape {block.shape}", f"{shape}")
    return block


def _triangle(root: F64, H: F64, b: F64) -> tuple[F64, F64]:
    """[H b], of which no row is more than √Ω times the given ones say together: upper triangular, by QR."""
    R = np.asarray(np.linalg.qr(root @ np.column_stack([H, b]), mode="r"), np.float64)
    return np.ascontiguousarray(R[:, :-1]), np.ascontiguousarray(R[:, -1])


def _root(where: str, information: F64) -> F64:
    """A with AᵀA = Ω."""
    try:
        return np.asarray(np.linalg.cholesky(information).T, np.float64)
    except np.linalg.LinAlgError:
        raise BadInformation(f"{where}: information", "not positive definite", "a positive definite matrix") from None
