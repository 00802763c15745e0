"""The tables and figures of Idris and others (2011), counted by the code that runs, with our column next to theirs.

Table 1 are the sizes of the matrices that the classical computation multiplies; Table 2 what each part of the
independent one multiplies; Figures 5, 8 and 10 the counts by iteration, by part, and by number of features.
"""

from pathlib import Path
from typing import Any

import numpy as np
from naive.random_cameras import random_observations

from factorbus import idp
from factorbus.idp import classical, independent, minimal
from factorbus.idp.kernels import independent as kernels

# What the paper says, and what has to come out.
STATED = {"classical": 87_702, "independent": 10_782}
_FIGURE_10 = (1, 2, 3, 5, 10, 20, 30)


def tables() -> dict[str, Any]:
    """Tables 1 and 2, Figures 5, 8 and 10, for a filter that has no feature yet."""
    return {
        "table_1": _table_1(),
        "table_2": _table_2(),
        "figure_5": [row["multiplications"] for row in _table_1()],
        "figure_8": _parts(3),
        "figure_10": [_all_three(n) for n in _FIGURE_10],
        "stated": STATED,
    }


def counted(n: int, existing: int = 0) -> dict[str, int]:
    """Multiplications of the three for n new features and a number of existing ones."""
    observations, P = random_observations(1, n, existing)
    seen = idp.see(observations)
    A, B = idp.jacobians(observations, seen)
    padd = idp.padd(observations)
    return {
        "classical": classical.covariance(P, A, B, padd).multiplications,
        "independent": independent.covariance(P, A, B, padd).multiplications,
        "minimal": minimal.covariance(P, observations, seen).multiplications,
        "minimal-half": half_count(observations, seen),
        "factored": minimal.covariance_factors(observations, seen).multiplications,
    }


def half_count(observations: Any, seen: Any) -> int:
    """Multiplications of the upper half."""
    parts = minimal.FeatureRows(observations, seen)
    return parts.multiplications + parts.half(0, len(seen.y)).multiplications


def _all_three(n: int) -> dict[str, int]:
    return {"features": n, **counted(n)}


def _table_1() -> list[dict[str, Any]]:
    """Sizes of J, P and Jᵀ in iterations 1 to 3, and what multiplying them takes."""
    observations, P = random_observations(1, 3)
    A, B = idp.jacobians(observations, idp.see(observations))
    rows = []
    for k in range(3):
        J, padded = classical.step_matrices(P, A[k], B[k], idp.padd(observations))
        P, count = classical.step(P, A[k], B[k], idp.padd(observations))
        rows.append({"iteration": k + 1, "J": J.shape, "P": padded.shape, "Jt": J.T.shape, "multiplications": count})
    return rows


def _parts(n: int) -> dict[str, int]:
    """What the independent computation of n features multiplies, by part."""
    observations, P = random_observations(1, n)
    A, B = idp.jacobians(observations, idp.see(observations))
    counts = np.zeros(kernels.COUNTS, np.int64)
    independent.some_rows(0, n, P[:13].copy(), A, B, idp.padd(observations), np.empty((13 + 6 * n, 13 + 6 * n)), counts)
    names = ("left", "right", "own_left", "own", "blocks")
    return dict(zip(names, counts.tolist(), strict=True))


def _table_2() -> list[list[str]]:
    """The cells of the new covariance for three features: P, cross-covariances, blocks, own parts on the diagonal."""
    n = 3
    part = _parts(n)
    left, right, block = part["left"] // n, part["right"] // n, part["blocks"] // (n * n)
    own = f"{block}+{part['own_left'] // n}+{part['own'] // n}"
    cells = [[str(left), *[own if k == i else str(block) for k in range(n)]] for i in range(n)]
    return [["P", *[str(right)] * n], *cells]


def draw(folder: Path, found: dict[str, Any]) -> list[Path]:
    """Figures 5, 8 and 10 as PNG files."""
    from matplotlib.figure import Figure

    paths = []
    for name, width, fill in (
        ("figure_5", 5.0, _draw_5),
        ("figure_8", 5.5, _draw_8),
        ("figure_10", 6.5, _draw_10),
    ):
        figure = Figure(figsize=(width, 4.0), layout="constrained")
        fill(figure.add_subplot(), found)
        paths.append(folder / f"idp_{name}.png")
        figure.savefig(paths[-1], dpi=160)
    return paths


def _draw_5(axes: Any, found: dict[str, Any]) -> None:
    rows = found["table_1"]
    bars = axes.bar([row["iteration"] for row in rows], [row["multiplications"] for row in rows], color="#E69F00")
    axes.bar_label(bars, fmt="{:,.0f}")
    axes.set(
        xticks=[1, 2, 3], xlabel="iteration", ylabel="multiplications", title="Classical: J P Jᵀ, one feature each"
    )


def _draw_8(axes: Any, found: dict[str, Any]) -> None:
    cells = found["table_2"]
    axes.set(xlim=(0, len(cells)), ylim=(len(cells), 0), xticks=[], yticks=[])
    axes.set_title(f"Independent: {STATED['independent']:,} multiplications for three features")
    for row, line in enumerate(cells):
        for column, text in enumerate(line):
            shade = "#DDDDDD" if row == column == 0 else "#CFE3F2" if 0 in (row, column) else "#F6E3C3"
            axes.add_patch(_box(column, row, shade))
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=9)


def _box(x: float, y: float, colour: str) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((x, y), 1, 1, facecolor=colour, edgecolor="white", linewidth=2)


def _draw_10(axes: Any, found: dict[str, Any]) -> None:
    rows = found["figure_10"]
    n = [row["features"] for row in rows]
    for name, colour in (("classical", "#E69F00"), ("independent", "#0072B2"), ("minimal", "#009E73")):
        axes.plot(n, [row[name] for row in rows], marker="o", markersize=4, color=colour, label=name)
    axes.set(yscale="log", xlabel="new features", ylabel="multiplications", title="Multiplications for the covariance")
    axes.grid(True, which="major", color="#E4E4E4")
    axes.legend(frameon=False)
