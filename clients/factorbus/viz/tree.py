"""The elimination tree of a system, and what of it a loop closure reaches."""

from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.viz import style
from factorbus.viz.sparsity import Pattern
from factorbus.wording import counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def parents_of(pattern: Pattern) -> I64:
    """(n,): of each block column, as they are eliminated, the first later one that its row of R has a block in; −1: a
    root."""
    parents = np.full(pattern.n, pattern.n)
    for blocks in (pattern.eliminated, pattern.fill):
        np.minimum.at(parents, blocks[:, 0], blocks[:, 1])
    return np.where(parents == pattern.n, -1, parents)


def reached_from(parents: I64, columns: I64) -> I64:
    """The columns whose rows of R change when factors on `columns` come: they and all their ancestors."""
    found = set()
    for column in columns.tolist():
        while column >= 0 and column not in found:
            found.add(column)
            column = int(parents[column])
    return np.array(sorted(found), np.int64)


def tree_figure(pattern: Pattern, touched: I64, title: str = "") -> "Figure":
    """The elimination tree, roots on top, as a matplotlib figure of its own.

    touched: columns in the order of elimination that a new factor joins; what it changes of R is drawn in colour.
    """
    import matplotlib as mpl
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    parents = parents_of(pattern)
    places, reached = places_of(parents), reached_from(parents, touched)
    child = np.flatnonzero(parents >= 0)
    edges = np.stack([places[child], places[parents[child]]], axis=1)
    changed = np.isin(child, reached)
    looks: dict[Any, Any] = style.SETTINGS | {"axes.grid": False}
    with mpl.rc_context(looks):
        figure = Figure(figsize=(9.5, 6.2), layout="constrained")
        axes = figure.add_subplot()
        for some, colour, width in ((~changed, style.TRUTH, 0.7), (changed, style.LOOPS, 1.8)):
            axes.add_collection(LineCollection(list(edges[some]), colors=colour, linewidths=width))
        _dots(axes, places, np.setdiff1d(np.arange(pattern.n), reached), style.ESTIMATE, 5, "stays as it is")
        _dots(axes, places, reached, style.LOOPS, 14, "is made again")
        _dots(axes, places, touched, style.INK, 46, "joined by the last loop closure", marker="D")
        axes.set_axis_off()
        axes.legend(loc="lower right", markerscale=1.2)
        about = f"{counted(pattern.n, 'block column')}; a tree {1 + int(-places[:, 1].min()):,} high"
        axes.set_title(about, loc="left", fontsize=9.5, color="#555555")
        figure.suptitle(title, x=0.012, ha="left", fontsize=13)
    return figure


def places_of(parents: I64) -> F64:
    """(n, 2): leaves side by side, each column above the middle of its children, one level a step of y."""
    n = len(parents)
    depth, leaves = np.zeros(n), np.ones(n)
    for column in range(n - 1, -1, -1):  # parents come after their children
        if parents[column] >= 0:
            depth[column] = depth[parents[column]] + 1
    is_leaf = np.ones(n, bool)
    is_leaf[parents[parents >= 0]] = False
    leaves[~is_leaf] = 0
    for column in range(n):
        if parents[column] >= 0:
            leaves[parents[column]] += leaves[column]
    start, taken, root = np.zeros(n), np.zeros(n), 0.0
    for column in range(n - 1, -1, -1):
        above = parents[column]
        if above < 0:
            start[column], root = root, root + leaves[column]
        else:
            start[column] = start[above] + taken[above]
            taken[above] += leaves[column]
    return np.stack([start + leaves / 2, -depth], axis=1)


def _dots(axes: Any, places: F64, columns: I64, colour: str, size: float, name: str, marker: str = "o") -> None:
    label = f"{name} ({len(columns):,})"
    axes.scatter(*places[columns].T, s=size, color=colour, marker=marker, linewidths=0, zorder=3, label=label)
