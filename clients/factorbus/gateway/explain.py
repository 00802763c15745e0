"""What holds a variable where it is: the service's own explanation of it (`ask/why`), and the same in words."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from factorbus.proto.asking import Why
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import MapGraph
from factorbus.proto.symbols import format_symbol
from factorbus.proto.why_text import fall_without
from factorbus.wording import counted

_WORDS = {
    "se2": "a pose in the plane",
    "se3": "a pose in space",
    "point2": "a point",
    "point3": "a point in space",
    "so3": "a rotation",
    "sim3": "a pose in space with a scale",
    "idp": "a feature of inverse depth",
}
_DOUBTFUL = 2.0


def explain(why: Why) -> dict[str, Any]:
    """{key, kind, value, fixed, revision, sigmas, conditioning, chi2, factors, step, text} of one variable; its worst
    factors first.

    sigmas: standard deviations in its tangent space, metres and radians.  chi2: what its factors count in χ².  A factor
    has id, kind, keys, chi2 = rᵀ Ω r, loss, weight and rho, what it counts with its loss; misfit = √(chi2 / dim): about
    1 where the information is right; known: the share of what it measures that is known from it and not from the
    others; without: by how much χ² would fall without it, to first order; null: nothing else measures it.
    """
    explained = why.variable
    rows = sorted(map(_row, explained["factors"]), key=lambda row: -row["chi2"])
    name = format_symbol(explained["key"])
    return {
        "key": name,
        "kind": explained["kind"],
        "value": explained["value"],
        "fixed": explained["fixed"],
        "revision": why.revision,
        "sigmas": explained["sigmas"],
        "conditioning": explained["conditioning"],
        "chi2": sum(row["rho"] for row in rows),
        "factors": rows,
        "step": f"{why.step['strategy']}: {why.step['because']}" if why.step else "",
        "text": _text(name, explained, rows, why.step),
    }


def explain_factor(why: Why, graph: MapGraph) -> dict[str, Any]:
    """One factor: what `explain` has of it, and residual, weighted = Lᵀ r with Ω = L Lᵀ, inactive, text; measured and
    sigmas, √ of the diagonal of Ω⁻¹ (metres, radians), where `graph` has the factor and Ω an inverse, else null."""
    measured, sigmas = _measured(why.factor["factor"], graph)
    reported = {name: why.factor[name] for name in ("residual", "weighted", "inactive")}
    at_hand = {"measured": measured, "sigmas": sigmas, "revision": why.revision, "text": why.text}
    return _row(why.factor) | reported | at_hand


def _measured(factor: int, graph: MapGraph) -> tuple[list[float] | None, list[float] | None]:
    for group in graph.batch.factors:
        at = np.flatnonzero(group.ids == factor)
        if at.size:
            row = group.information[at[0]]
            dim = int((np.sqrt(8 * row.size + 1) - 1) / 2)
            omega = np.zeros((dim, dim))
            omega[np.triu_indices(dim)] = row
            omega += np.triu(omega, 1).T
            sigmas = None
            if np.linalg.matrix_rank(omega, hermitian=True) == dim:
                found = np.sqrt(np.diag(np.linalg.inv(omega)))
                found[FACTOR_KINDS[group.kind].half_angle_rows] *= 2.0
                sigmas = found.tolist()
            return group.measured[at[0]].tolist(), sigmas
    return None, None


def _row(factor: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "id": factor["factor"],
        "kind": factor["kind"],
        "keys": [format_symbol(key) for key in factor["keys"]],
        "chi2": factor["chi2"],
        "loss": factor["loss"],
        "weight": factor["weight"],
        "rho": factor["rho"],
        "misfit": math.sqrt(factor["chi2"] / factor["dims"]),
        "known": factor["leverage"] / factor["dims"],
        "without": factor["without"],
    }


def _text(name: str, explained: Mapping[str, Any], rows: list[dict[str, Any]], step: Mapping[str, Any]) -> str:
    """In a sentence or four."""
    what = f"{name} is {_WORDS.get(explained['kind'], 'of kind ' + explained['kind'])}"
    if explained["fixed"]:
        return f"{what}, and fixed: it is not estimated. {_leading(len(rows))}"
    if not rows:
        return f"{what}, and no factor holds it."
    others = sorted({key for row in rows for key in row["keys"]} - {name})
    held = f"{what}, held by {counted(len(rows), 'factor')}"
    held += f" to {', '.join(others[:4])}{' and others' if len(others) > 4 else ''}." if others else "."
    return f"{held} {_certainty(explained)}{_fit(rows[0], step)}"


def _leading(count: int) -> str:
    return f"{counted(count, 'factor')} {'leads' if count == 1 else 'lead'} away from it."


def _certainty(explained: Mapping[str, Any]) -> str:
    """How well it is known, where its tangent is metres and radians."""
    sigmas, kind = explained["sigmas"], explained["kind"]
    if kind not in _WORDS or kind == "idp":
        return ""
    places, turns = (sigmas[:2], sigmas[2:]) if kind in ("se2", "point2") else (sigmas[:3], sigmas[3:])
    turned = f" and {math.degrees(max(turns)):.2g}°" if turns else ""
    return f"Its place is known to {max(places):.2g} m{turned} (one standard deviation). "


def _fit(worst: dict[str, Any], step: Mapping[str, Any]) -> str:
    by = f"{worst['misfit']:.1f} of its standard deviations"
    if worst["misfit"] > _DOUBTFUL:
        fall = worst["without"]
        without = "" if fall is None else f"; without it χ² would fall by {fall_without(fall, step)}"
        ends = ", ".join(worst["keys"])
        return f"{worst['kind']} ({ends}) contradicts the rest: it misses by {by}{without}."
    return f"All agree: the worst misses by {by}."
