"""A drive as a picture: χ² against the batch optimum, time by what a step did, and how much of the map it works on."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.viz import style
from factorbus.viz.history import DriveHistory
from factorbus.viz.panels import chi2_panel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Marks differ in form as well as in colour.
_LOOKS = (
    (style.ESTIMATE, "o"),
    (style.ODOMETRY, "^"),
    (style.POINTS, "s"),
    (style.LOOPS, "D"),
    (style.INK, "v"),
    (style.TRUTH, "P"),
)


def drive_figure(history: DriveHistory, strategies: Sequence[str], title: str = "", subtitle: str = "") -> "Figure":
    """χ², times of steps, their sum, and the work along a drive, as a matplotlib figure of its own.

    strategies: what each step did, one word for each of `history.step_ms`.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(style.SETTINGS):
        figure = Figure(figsize=(9.5, 10.6 if len(history.work) else 8.6), layout="constrained")
        heights = [1.0, 1.25, 0.7, 0.9] if len(history.work) else [1.0, 1.25, 0.7]
        panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        chi2_panel(panels[0], history)
        _times(panels[1], history.step_ms, np.asarray(strategies))
        _sum(panels[2], history.step_ms)
        if len(history.work):
            _work(panels[3], history.work)
        for axes in panels[:-1]:
            axes.set_xlabel("")
        figure.suptitle(f"{title}   {subtitle}".strip(), x=0.012, ha="left", fontsize=12)
    return figure


def _times(axes: Any, step_ms: F64, strategies: Any) -> None:
    """One mark a step, by strategy; the commonest below the others."""
    steps = np.arange(1, len(step_ms) + 1)
    names, counts = np.unique(strategies, return_counts=True)
    for place, index in enumerate(np.argsort(-counts)):
        colour, mark = _LOOKS[place % len(_LOOKS)]
        here = strategies == names[index]
        axes.plot(
            steps[here],
            np.maximum(step_ms[here], 1e-3),
            mark,
            markersize=2.4 if place == 0 else 3.6,
            color=colour,
            markeredgewidth=0,
            alpha=0.8,
            label=f"{names[index]} ({counts[index]:,})",
            rasterized=counts[index] > 3000,
        )
    axes.axhline(float(np.percentile(step_ms, 50)), color=style.INK, linewidth=0.9)
    axes.axhline(float(np.percentile(step_ms, 99)), color=style.INK, linewidth=0.9, linestyle=(0, (4, 2)))
    p50, p99 = np.percentile(step_ms, (50, 99))
    axes.set_title(f"time of a step (ms): p50 {p50:.2g}, p99 {p99:.2g}, dashed", loc="left")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(loc="upper left", ncols=len(names), columnspacing=1.2, handletextpad=0.3, markerscale=1.6)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.2)  # room for the legend


def _sum(axes: Any, step_ms: F64) -> None:
    axes.plot(np.arange(1, len(step_ms) + 1), np.cumsum(step_ms) / 1e3, color=style.ESTIMATE, linewidth=1.4)
    axes.set_title("time in the solver, added up (s)", loc="left")
    axes.set_xlabel("step")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)


def _work(axes: Any, work: F64) -> None:
    """Of how many variables there are, how many a step eliminated and relinearized."""
    steps = np.arange(1, len(work) + 1)
    axes.plot(steps, work[:, 0], color=style.INK, linewidth=1.2, label="in the map")
    for column, name, colour, mark in ((1, "eliminated", style.ESTIMATE, "o"), (2, "relinearized", style.LOOPS, "D")):
        done = work[:, column] > 0
        axes.plot(steps[done], work[done, column], mark, markersize=2.6, color=colour, markeredgewidth=0, label=name)
    axes.set_title("variables: in the map, and worked on by a step", loc="left")
    axes.set_xlabel("step")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(loc="upper left", ncols=3, columnspacing=1.2, handletextpad=0.3, markerscale=1.6)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.25)  # room for the legend
    axes.margins(x=0.01)
