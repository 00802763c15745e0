"""Figures 1 and 2 of the paper with our numbers: what the constraint and what ordering by blocks cost in fill-in."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from factorbus.viz import style

from .fill import RECENT

Filled = tuple[str, dict[str, Any], Path]  # title, numbers, file of the pictures

_INK = LinearSegmentedColormap.from_list("ink", ["#FFFFFF", "#56B4E9", "#0072B2", "#10243E"])
_CONSTRAINT = (
    ("lambda", "Λ, in order of arrival"),
    ("blocks", "R, no constraint"),
    ("blocks_constrained", "R, last pose last"),
    ("blocks_recent", f"R, and landmarks of {RECENT} poses before it"),
)
_ELEMENTS = (
    ("elements", "R, by elements"),
    ("blocks", "R, by blocks"),
    ("elements_constrained", "R, by elements, constrained"),
    ("blocks_constrained", "R, by blocks, constrained"),
)


def constraint_figure(path: Path, systems: Sequence[Filled]) -> None:
    """Fig. 1: Λ, and R with and without the constraint, ordered by blocks."""
    _figure(path, systems, _CONSTRAINT, "Fig. 1   Fill-in of R with and without the constraint, by blocks")


def elements_figure(path: Path, systems: Sequence[Filled]) -> None:
    """Fig. 2: R ordered by elements and by blocks, without and with the constraint."""
    _figure(path, systems, _ELEMENTS, "Fig. 2   Fill-in of R by elements and by blocks")


def _figure(path: Path, systems: Sequence[Filled], columns: Sequence[tuple[str, str]], title: str) -> None:
    """A row for each system, a column for each pattern; darker cells have more nonzeros."""
    with mpl.rc_context({**style.SETTINGS, "axes.grid": False, "axes.spines.right": True, "axes.spines.top": True}):
        figure = Figure(figsize=(3.1 * len(columns), 3.4 * len(systems) + 0.5), layout="constrained")
        grid = figure.subplots(len(systems), len(columns), squeeze=False)
        for row, (name, numbers, file) in zip(grid, systems, strict=True):
            with np.load(file) as pictures:
                for axes, (pattern, words) in zip(row, columns, strict=True):
                    _spy(axes, pictures[pattern], numbers["scalars"])
                    axes.set_title(f"{words}\n{_count(numbers, pattern)}", loc="left", fontsize=8.5)
            row[0].set_ylabel(name, fontsize=10)
        figure.suptitle(title, x=0.012, ha="left", fontsize=13)
        figure.savefig(path, dpi=150)


def _spy(axes: Any, picture: np.ndarray, scalars: int) -> None:
    """Cells with any nonzero are seen; the fourth root keeps single ones visible beside full ones."""
    axes.imshow(
        np.where(picture > 0, 0.18 + 0.82 * picture**0.25, 0.0),
        cmap=_INK,
        vmin=0,
        vmax=1,
        extent=(0, scalars, scalars, 0),
        interpolation="nearest",
    )
    axes.set_xticks([0, scalars])
    axes.set_yticks([0, scalars])


def _count(numbers: dict[str, Any], pattern: str) -> str:
    if pattern == "lambda":
        return f"{numbers['nnz_lambda']:,} nonzeros (upper half)"
    nnz = numbers["nnz"]
    base = nnz["blocks"] if pattern.startswith("blocks") else nnz["elements"]
    more = f" ({100 * (nnz[pattern] / base - 1):+.2f} %)" if pattern.endswith(("constrained", "recent")) else ""
    return f"{nnz[pattern]:,} nonzeros{more}"
