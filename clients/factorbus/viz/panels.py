"""The panels below a map: χ² against the batch optimum and the time of each step, along the drive."""

from typing import Any

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.viz import style
from factorbus.viz.history import DriveHistory


def chi2_panel(axes: Any, history: DriveHistory) -> None:
    """χ² after every step, with the batch optimum where it was computed."""
    steps = np.arange(1, len(history.chi2) + 1)
    axes.plot(steps, history.chi2, color=style.ESTIMATE, linewidth=1.4, label="after the step")
    shown = (history.optimum, "o", "batch optimum"), (history.not_converged, "X", "batch, not converged")
    for optima, marker, label in shown:
        if len(optima):
            axes.plot(
                *optima.T,
                marker,
                markersize=4.5,
                markerfacecolor="white",
                markeredgecolor=style.INK,
                label=label,
            )
    if any(len(optima) for optima, _, _ in shown):
        axes.legend(loc="upper left", handlelength=1.2)
    axes.set_title("χ² along the drive", loc="left")
    axes.set_xlabel("step")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)


def time_panel(axes: Any, history: DriveHistory) -> None:
    """The time of every step, with its median and 99th percentile."""
    times = np.maximum(history.step_ms, 1e-3)
    steps = np.arange(1, len(times) + 1)
    axes.plot(
        steps,
        times,
        ".",
        markersize=2.2,
        color=style.ESTIMATE,
        alpha=_opacity(times),
        markeredgewidth=0,
        rasterized=True,
    )
    for share, dashes in ((50, "solid"), (99, (0, (4, 2)))):
        value = float(np.percentile(times, share))
        axes.axhline(value, color=style.INK, linewidth=0.9, linestyle=dashes, label=f"p{share}  {value:.2g} ms")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_title("time of a step (ms)", loc="left")
    axes.set_xlabel("step")
    axes.margins(x=0.01)
    axes.legend(loc="upper left", handlelength=1.8, ncols=2, columnspacing=1.2)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.25)  # room for the legend


def _opacity(points: F64) -> float:
    return float(np.clip(4000 / max(len(points), 1), 0.15, 0.8))
