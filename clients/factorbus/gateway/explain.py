"""What holds a variable where it is: its factors, how well each fits, and the same in words."""

from typing import Any

import numpy as np

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Factors, Graph
from factorbus.proto.problems import Problem
from factorbus.proto.symbols import format_symbol
from factorbus.viz.residuals import Values, factor_chi2

_WORDS = {"se2": "a pose in the plane", "se3": "a pose in space", "point2": "a point", "point3": "a point in space"}
_DOUBTFUL = 2.0


class NotInMap(Problem):
    """A question about a variable that the map does not have."""

    code = "unknown_variable"


def explain(graph: Graph, key: int) -> dict[str, Any]:
    """{key, kind, value, fixed, revision, chi2, factors, text} of one variable; its worst factors first.

    A factor has kind, keys, chi2 = rᵀ Ω r, and misfit = √(chi2 / dim): about 1 where the information is right.
    Raises NotInMap.
    """
    kind, value, fixed = _find(graph, key)
    values = Values(graph.batch.variables)
    rows = [row for group in graph.batch.factors for row in _rows(group, key, values)]
    rows.sort(key=lambda row: -(row["chi2"] if row["chi2"] is not None else -1.0))
    name = format_symbol(key)
    return {
        "key": name,
        "kind": kind,
        "value": value,
        "fixed": fixed,
        "revision": graph.revision,
        "chi2": sum(row["chi2"] or 0.0 for row in rows),
        "factors": rows,
        "text": _text(name, kind, fixed, rows),
    }


def _find(graph: Graph, key: int) -> tuple[str, list[float], bool]:
    for group in graph.batch.variables:
        at = np.flatnonzero(group.keys == key)
        if at.size and group.values is not None:
            return group.kind, group.values[at[0]].tolist(), group.fixed
    raise NotInMap(f"the map has no {format_symbol(key)} at revision {graph.revision}")


def _rows(group: Factors, key: int, values: Values) -> list[dict[str, Any]]:
    here = np.flatnonzero((group.keys == key).any(axis=1))
    some = Factors(group.kind, group.keys[here], group.measured[here], group.information[here])
    dim = FACTOR_KINDS[group.kind].dim if group.kind in FACTOR_KINDS else 1
    rows = []
    for keys, chi2 in zip(some.keys.tolist(), factor_chi2(some, values).tolist(), strict=True):
        known = chi2 == chi2  # not NaN: a kind of factor that came after this page
        rows.append(
            {
                "kind": group.kind,
                "keys": [format_symbol(each) for each in keys],
                "chi2": chi2 if known else None,
                "misfit": (chi2 / dim) ** 0.5 if known else None,
            }
        )
    return rows


def _text(name: str, kind: str, fixed: bool, rows: list[dict[str, Any]]) -> str:
    """In a sentence or three."""
    what = f"{name} is {_WORDS.get(kind, f'of kind {kind}')}"
    if fixed:
        return f"{what}, and fixed: it is not estimated. {len(rows)} factors lead away from it."
    if not rows:
        return f"{what}, and no factor holds it."
    others = sorted({key for row in rows for key in row["keys"]} - {name})
    held = f"{what}, held by {len(rows)} factor{'s' if len(rows) > 1 else ''}"
    held += f" to {', '.join(others[:4])}{' and others' if len(others) > 4 else ''}." if others else "."
    worst = rows[0]
    if worst["misfit"] is None:
        return held
    if worst["misfit"] > _DOUBTFUL:
        return (
            f"{held} {worst['kind']} ({', '.join(worst['keys'])}) contradicts the rest: it misses by "
            f"{worst['misfit']:.1f} of its standard deviations."
        )
    return f"{held} All agree: the worst misses by {worst['misfit']:.1f} of its standard deviations."
