"""Figures of `bench peers`: the time of a step along the replays, how many times faster than iSAM2, growth."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from factorbus.viz import style

from .figures import LOOKS, handles_of, in_order, sheet
from .peer_targets import BARS, MEAN_TIMES, times_faster


def steps_figure(path: Path, curves: dict[str, list[dict[str, Any]]], titles: dict[str, str]) -> None:
    """The time of a step along the replays, one panel a data set: medians as lines, longest steps as dots."""
    axes_of, finish = sheet(
        len(curves), 3.0, "Time of a step (ms) along the replay (poses): median, and longest as dots"
    )
    for axes, (dataset, runs) in zip(axes_of, curves.items(), strict=True):
        for run in in_order(runs):
            look, along = LOOKS[run["contestant"]], run["along"]
            axes.plot(along["step"], along["p50"], **look)
            axes.plot(along["step"], along["max"], color=look["color"], linestyle="", marker=".", markersize=2)
        axes.set_yscale("log")
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(titles[dataset], loc="left")
    finish(path, handles_of({run["contestant"] for runs in curves.values() for run in runs}))


def ratios_figure(path: Path, rows: Sequence[dict[str, Any]], judged: str) -> None:
    """iSAM2's time over ours on each data set, and what was to be reached."""
    known = [row for row in rows if row["name"] == judged and times_faster(row)]
    with mpl.rc_context(style.SETTINGS):
        figure = Figure(figsize=(7.5, 0.42 * max(len(known), 2) + 1.6), layout="constrained")
        axes = figure.subplots()
        places = np.arange(len(known))[::-1]
        axes.barh(places, [times_faster(row) for row in known], height=0.6, color="#56B4E9", zorder=2)
        for place, row in zip(places, known, strict=True):
            if bar := BARS.get(row["dataset"]):
                axes.plot([bar.times] * 2, [place - 0.4, place + 0.4], color="black", linewidth=1.8, zorder=3)
        axes.axvline(MEAN_TIMES, color="#999999", linestyle=":", zorder=1)
        axes.set_yticks(places, [row["title"] for row in known])
        axes.set_xlabel("times the CPU time of iSAM2's update(); a stroke: to be reached; dotted: in the mean")
        figure.suptitle(f"iSAM2 / {judged}", x=0.012, ha="left", fontsize=13)
        figure.savefig(path, dpi=150)


def growth_figure(path: Path, found: dict[str, Any], judged: str) -> None:
    """Median and p99 of the steps in windows of a long drive."""
    with mpl.rc_context(style.SETTINGS):
        figure = Figure(figsize=(7.0, 3.8), layout="constrained")
        axes = figure.subplots()
        ends = [window["to"] for window in found["windows"]]
        for name, marker in (("p50", "o"), ("p99", "s"), ("max", "^")):
            axes.plot(ends, [window[name] for window in found["windows"]], marker=marker, markersize=4, label=name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("poses")
        axes.set_ylabel("ms")
        axes.legend()
        figure.suptitle(f"{judged}: the time of a step as the map grows", x=0.012, ha="left", fontsize=13)
        figure.savefig(path, dpi=150)
