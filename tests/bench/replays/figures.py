"""Figures 3, 4 and 5 of the paper with our numbers: the maps, the cumulative time, χ² along the replay of 10k."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from factorbus.viz import style

from .chi2 import ratio
from .contestants import ENTRIES
from .problems import Problem

# Okabe and Ito's colours, which differ for colour-blind readers as well; dashes tell them apart in grey.
LOOKS: dict[str, dict[str, Any]] = {
    "inc-l": {"color": "#D55E00", "linewidth": 1.8, "zorder": 6},
    "all-batch": {"color": "#009E73", "linewidth": 1.6, "zorder": 5},
    "inc-l-b10": {"color": "#E69F00", "linewidth": 1.1, "zorder": 4},
    "inc-l-b100": {"color": "#CC79A7", "linewidth": 1.1, "zorder": 3},
    "auto": {"color": "#000000", "linewidth": 1.6, "zorder": 7},
    "bayes-tree": {"color": "#000000", "linewidth": 1.4, "linestyle": (0, (4, 1)), "zorder": 6},
    "isam2-0.1": {"color": "#0072B2", "linewidth": 1.3, "linestyle": (0, (5, 2)), "zorder": 4},
    "isam2-0.01": {"color": "#56B4E9", "linewidth": 1.3, "linestyle": (0, (5, 2)), "zorder": 3},
    "isam2-0.1-qr": {"color": "#0072B2", "linewidth": 1.0, "linestyle": (0, (1, 1.5)), "zorder": 2},
    "isam2-0.01-qr": {"color": "#56B4E9", "linewidth": 1.0, "linestyle": (0, (1, 1.5)), "zorder": 2},
    "isam2-0.1-fine": {"color": "#0072B2", "linewidth": 1.0, "linestyle": (0, (6, 1, 1, 1, 1, 1)), "zorder": 2},
    "isam2-0.1-update": {"color": "#0072B2", "linewidth": 1.3, "linestyle": (0, (3, 1))},
    "isam2-0.1-update-as-read": {"color": "#0072B2", "linewidth": 1.3, "linestyle": (0, (1, 1))},
    "isam2-0.1-skip10-update": {"color": "#0072B2", "linewidth": 1.1, "linestyle": (0, (6, 1))},
    "isam2-0.1-skip10-update-as-read": {"color": "#0072B2", "linewidth": 1.1, "linestyle": (0, (2, 1))},
    "isam2-0.1-adaptive-update": {"color": "#0072B2", "linewidth": 0.9, "linestyle": (0, (3, 1, 1, 1))},
    "isam2-0.1-partial-update": {"color": "#0072B2", "linewidth": 0.9, "linestyle": (0, (5, 1, 1, 1))},
    "isam2-0.01-skip10-update": {"color": "#56B4E9", "linewidth": 1.1, "linestyle": (0, (6, 1))},
    "isam2-0.01-update": {"color": "#56B4E9", "linewidth": 1.3, "linestyle": (0, (3, 1))},
    "gn-loop": {"color": "#666666", "linewidth": 1.1, "linestyle": (0, (2, 2)), "zorder": 2},
    "g2o-b1": {"color": "#555555", "linewidth": 1.1, "linestyle": (0, (4, 1, 1, 1)), "zorder": 2},
    "g2o-b10": {"color": "#999999", "linewidth": 1.1, "linestyle": (0, (4, 1, 1, 1)), "zorder": 1},
}
# In Fig. 5; g2o every ten poses has no answer in between, so a line of it would mislead.
_COMPARED = ("all-batch", "inc-l", "inc-l-b10", "inc-l-b100", "isam2-0.1", "isam2-0.01")


def maps_figure(path: Path, maps: Sequence[tuple[Problem, Path]]) -> None:
    """Fig. 3: the optimal map of each problem; poses as a line, landmarks as marks."""
    axes_of, finish = sheet(len(maps), 3.4, "Fig. 3   The maps at the optimum (metres)")
    for axes, (problem, file) in zip(axes_of, maps, strict=True):
        with np.load(file) as values:
            poses = values["se2"] if "se2" in values else values["se3"]
            points = values["point2"] if "point2" in values else np.empty((0, 2))
            axes.plot(poses[:, 0], poses[:, 1], color=style.ESTIMATE, linewidth=0.6, rasterized=len(poses) > 3000)
            axes.scatter(points[:, 0], points[:, 1], s=14, marker="^", color=style.POINTS, edgecolors="white", lw=0.3)
        axes.set_aspect("equal", adjustable="datalim")
        counted = f"{len(poses):,} poses" + (f", {len(points)} landmarks" if len(points) else "")
        axes.set_title(f"{problem.label}\n{counted}", loc="left")
    finish(path)


def time_figure(path: Path, curves: dict[str, list[dict[str, Any]]], titles: dict[str, str], name: str) -> None:
    """Fig. 4: solver time used up to each pose, one panel a data set.

    curves: data set -> runs; a logarithmic axis, because the slowest takes hundreds of times as long as the fastest.
    name: what the figure is called.
    """
    axes_of, finish = sheet(len(curves), 3.0, f"{name}Cumulative time (CPU seconds) along the replay (poses)")
    for axes, (dataset, runs) in zip(axes_of, curves.items(), strict=True):
        for run in in_order(runs):
            steps, seconds = (np.array(part, float) for part in run["cumulative"])
            keep = seconds > 0
            axes.plot(steps[keep], seconds[keep], **LOOKS[run["contestant"]])
        axes.set_yscale("log")
        axes.set_ylim(bottom=1e-3)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(titles[dataset], loc="left")
    finish(path, handles_of({run["contestant"] for runs in curves.values() for run in runs}))


def chi2_figure(path: Path, title: str, runs: Sequence[dict[str, Any]], batch: dict[int, float]) -> None:
    """Fig. 5: χ² along one replay; below, how far it is above the optimum of the same step."""
    compared = [run for run in in_order(runs) if run["contestant"] in _COMPARED and run["chi2"]]
    with mpl.rc_context(style.SETTINGS):
        figure = Figure(figsize=(9.5, 7.0), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1.15))
        steps = np.array(sorted(batch))
        optimum = np.array([batch[int(step)] for step in steps])
        upper.plot(steps, optimum, color="#BBBBBB", linewidth=4, label="optimum", zorder=1)
        for run in compared:
            at, chi2 = (np.array(part) for part in zip(*run["chi2"], strict=True))
            excess = [ratio(value, batch[int(step)]) - 1 for step, value in run["chi2"]]
            upper.plot(at, chi2, label=ENTRIES[run["contestant"]].label, **LOOKS[run["contestant"]])
            lower.plot(at, np.maximum(excess, 1e-10), marker=".", markersize=3, **LOOKS[run["contestant"]])
        upper.set_ylabel("χ²")
        upper.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))
        upper.legend(loc="upper left", ncols=2)
        lower.set_yscale("log")
        lower.set_ylabel("χ² / χ²_batch − 1   (below 1e-10: drawn there)")
        lower.set_xlabel("pose")
        figure.suptitle(f"Fig. 5   χ² along the replay: {title}", x=0.012, ha="left", fontsize=13)
        figure.savefig(path, dpi=150)


def sheet(count: int, height: float, title: str) -> tuple[list[Any], Callable[..., None]]:
    """Panels on one page, three in a row, and what saves them, with a legend if there are handles."""
    columns = min(3, count)
    rows = -(-count // columns)
    with mpl.rc_context(style.SETTINGS):
        figure = Figure(figsize=(max(3.9 * columns, 6.5), height * rows + 0.9), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        panels = list(grid.ravel())
        figure.suptitle(title, x=0.012, ha="left", fontsize=13)
        for empty in panels[count:]:
            empty.set_axis_off()

    def finish(path: Path, handles: Sequence[Any] = ()) -> None:
        with mpl.rc_context(style.SETTINGS):
            if handles:
                figure.legend(handles=list(handles), loc="outside lower center", ncols=min(4, len(handles)))
            figure.savefig(path, dpi=150)

    return panels[:count], finish


def handles_of(names: set[str]) -> list[Any]:
    """Entries of a legend."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], label=ENTRIES[name].label, **LOOKS[name]) for name in ENTRIES if name in names]


def in_order(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """As the table has them; runs that got nowhere are left out."""
    there = {run["contestant"]: run for run in runs if run.get("done")}
    return [there[name] for name in ENTRIES if name in there]
