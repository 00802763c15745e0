"""What a front end has linearized itself, as a linear factor."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import all_finite, as_numbers, checked_flag, of_type
from factorbus.client.certainty import Certainty, full, loss_of, triangle_of
from factorbus.proto.arrays import F64
from factorbus.proto.kinds import MOST_JOINED, VARIABLE_KINDS, linear_kind
from factorbus.proto.messages import Factors
from factorbus.proto.problems import BadInformation, BadShape, UnknownKind
from factorbus.proto.symbols import format_symbol


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
    trusted = checked_flag(f"{where}: trusted", certainty.get("trusted", False))
    y = [all_finite(where, as_numbers(f"{where}: values", value)) for value in values]
    names = [of_type(f"{where}: kinds", kind, str, "names of kinds of variables") for kind in kinds]
    if len(names) == len(y) and not all(names):
        names = _all_kinds(where, keys, y, jacobians, names)
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
    return Factors(kind, ends, measured, triangle[None], loss, np.array([scale]) if loss else None, None, trusted)


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


def _all_kinds(
    where: str, keys: Sequence[int], y: Sequence[F64], jacobians: Sequence[ArrayLike], names: Sequence[str]
) -> list[str]:
    """The kinds, where one without a name, "", can be no other: by the numbers of y and of a row of H.

    Raises BadShape: two numbers are a point2 or a vector2, three an se2, point3 or vector3, six an idp or a vector6.
    """
    found = list(names)
    _check_counts(where, keys, len(y), len(jacobians), len(names))
    for n, (key, value, J) in enumerate(zip(keys, y, jacobians, strict=True)):
        if found[n]:
            continue
        could = _could_be(value, as_numbers(f"{where}: jacobian of {format_symbol(key)}", J))
        if len(could) != 1:
            which = " or ".join([", ".join(could[:-1]), could[-1]]) if could else "of no kind"
            seen = f"shape {value.shape}, with a jacobian of shape {np.shape(J)}: {which}"
            wanted = f"kinds=, one for each of the {len(keys)}, such as kinds={_example(found, n, could)}"
            raise BadShape(f"{where}: value of {format_symbol(key)}, which is not in this draft", seen, wanted)
        found[n] = could[0]
    return found


def _could_be(value: F64, J: F64) -> list[str]:
    """The kinds of variables of that size, and of that size of their tangent space."""
    columns = J.shape[1] if J.ndim == 2 else -1
    kinds = [kind for kind in VARIABLE_KINDS.values() if value.shape == (kind.size,)]
    return [kind.name for kind in kinds if columns in (kind.dim, -1)] or [kind.name for kind in kinds]


def _example(names: Sequence[str], n: int, could: Sequence[str]) -> list[str]:
    """What `kinds=` could be; "..." for those that are not known either."""
    return [name or (could[-1] if k == n and could else "...") for k, name in enumerate(names)]


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
