"""The picture of a map: what the robot thought, what is so, and what held it together."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.messages import Variables
from factorbus.viz import style
from factorbus.viz.ellipses import Spread, draw_outlines
from factorbus.viz.files import BadPicture, checked_ending, save
from factorbus.viz.geometry import Track, View, limits, line_of, points_of, segments_of, track_of, view_of
from factorbus.viz.history import DriveHistory
from factorbus.viz.panels import chi2_panel, time_panel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_LOOPS = 150_000  # more would take minutes and show nothing new; the legend says how many were left out
_MANY = 3000  # things of one kind above which an svg or pdf gets them as pixels


@dataclass(frozen=True, slots=True, eq=False)
class MapLayers:
    """What is drawn of a map.

    estimate, odometry, truth: groups of variables with values; poses become lines in the order of their keys, one
    for each letter; points become marks.  loops (m, 2): keys of poses joined by loop closures, drawn between their
    estimates.  spread: where variables may be.
    """

    estimate: Sequence[Variables]
    odometry: Sequence[Variables] = ()
    truth: Sequence[Variables] = ()
    loops: I64 | None = None
    spread: Spread | None = None


def save_map(
    path: str | os.PathLike[str],
    layers: MapLayers,
    *,
    history: DriveHistory | None = None,
    title: str = "",
    subtitle: str = "",
) -> None:
    """Draw a map (see `map_figure`) into a .png, .svg or .pdf file.  Raises BadPicture, or OSError from the file."""
    checked_ending(path)
    save(map_figure(layers, history=history, title=title, subtitle=subtitle), path, title)


def map_figure(
    layers: MapLayers, *, history: DriveHistory | None = None, title: str = "", subtitle: str = ""
) -> "Figure":
    """The map as a matplotlib figure of its own (no pyplot, no window).

    history: panels below the map.  Lengths are in metres and axes equal.  Poses that fill space are drawn in space,
    others in the plane they lie in.
    Raises BadPicture when there is no pose or no point to draw.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    drawn = _Drawing(layers)
    with mpl.rc_context(style.SETTINGS):
        panels = _panels(history)
        heights = [1.0, 0.05, 0.26] if panels else [1.0, 0.05]  # map, legend, panels
        figure = Figure(figsize=(9.0, 7.4 * sum(heights) + 1.0), layout="constrained")
        grid = figure.add_gridspec(len(heights), max(len(panels), 1), height_ratios=heights)
        axes = figure.add_subplot(grid[0, :], projection="3d" if drawn.view.in_space else None)
        _legend(figure.add_subplot(grid[1, :]), drawn.draw(axes))
        for column, panel in enumerate(panels):
            panel(figure.add_subplot(grid[2, column]), history)
        figure.suptitle(title, x=0.012, ha="left", fontsize=13)
        axes.set_title(subtitle, loc="left", fontsize=9.5, color="#555555", pad=8)
    return figure


def _panels(history: DriveHistory | None) -> list[Any]:
    """The panels for which there are numbers."""
    if history is None:
        return []
    return [panel for panel, there in ((chi2_panel, len(history.chi2)), (time_panel, len(history.step_ms))) if there]


def _legend(axes: Any, handles: list[Any]) -> None:
    """All layers by name, in a strip of their own below the map."""
    axes.set_axis_off()
    columns = len(handles) if len(handles) <= 5 else -(-len(handles) // 2)
    axes.legend(handles=handles, loc="center", ncols=columns, handlelength=1.6, columnspacing=1.6, borderpad=0)


class _Drawing:
    """All that is drawn into the map, from the lowest layer to the highest."""

    def __init__(self, layers: MapLayers) -> None:
        estimate, odometry, truth, loops = layers.estimate, layers.odometry, layers.truth, layers.loops
        self.spread = layers.spread
        self.estimate, self.odometry, self.truth = track_of(estimate), track_of(odometry), track_of(truth)
        self.points, self.true_points = points_of(estimate), points_of(truth)
        if not len(self.estimate.keys) and not len(self.points.keys):
            raise BadPicture("there is neither a pose nor a point with a value to draw")
        self.loops = segments_of(self.estimate, loops) if loops is not None and len(loops) else np.empty((0, 2, 2))
        self.view: View = view_of(self.estimate.places if len(self.estimate.keys) else self.points.places)

    def draw(self, axes: Any) -> list[Any]:
        """Draw all layers into `axes`, with labels and limits; their handles for a legend."""
        handles = [
            self._line(axes, self.odometry, "odometry alone", style.ODOMETRY, width=0.7, opacity=0.8),
            self._line(axes, self.truth, "truth", style.TRUTH, width=2.0 if self.view.in_space else 3.4, opacity=0.5),
            self._line(axes, self.estimate, "estimate", style.ESTIMATE, width=1.2),
            self._loops(axes),
            self._marks(axes, self.true_points, "true landmark", style.TRUTH, hollow=True),
            self._marks(axes, self.points, "landmark", style.POINTS, hollow=False),
            draw_outlines(axes, self.spread, self.view) if self.spread is not None else None,
            self._start(axes),
        ]
        self._frame(axes)
        return [handle for handle in handles if handle is not None]

    def _line(self, axes: Any, track: Track, name: str, colour: str, width: float, opacity: float = 1.0) -> Any:
        if not len(track.keys):
            return None
        count = len(track.keys)
        line = self.view(line_of(track))
        (handle,) = axes.plot(
            *line.T,
            color=colour,
            linewidth=width * _thinner(count),
            alpha=opacity,
            solid_joinstyle="round",
            label=_counted(name, count if name == "estimate" else 0, "poses"),
            rasterized=count > 20 * _MANY,
        )
        return handle

    def _loops(self, axes: Any) -> Any:
        count = len(self.loops)
        if not count:
            return None
        from matplotlib.collections import LineCollection
        from matplotlib.lines import Line2D

        every = -(-count // _MOST_LOOPS)
        name = f"loop closures ({count:,}{f', one in {every} drawn' if every > 1 else ''})"
        looks = {
            "colors": style.LOOPS,
            "linewidths": 0.75 * _thinner(count),
            "alpha": float(np.clip(2500 / count, 0.06, 0.5 if self.view.in_space else 0.8)),
            "zorder": 2.5,
            "rasterized": count > _MANY,
        }
        segments = self.view(self.loops[::every])
        if self.view.in_space:
            from mpl_toolkits.mplot3d.art3d import Line3DCollection

            axes.add_collection3d(Line3DCollection(segments, **looks))
        else:
            axes.add_collection(LineCollection(list(segments), **looks), autolim=False)
        return Line2D([], [], color=style.LOOPS, linewidth=1.2, label=name)

    def _marks(self, axes: Any, points: Track, name: str, colour: str, hollow: bool) -> Any:
        if not len(points.keys):
            return None
        size = 34 * _thinner(10 * len(points.keys)) ** 2
        return axes.scatter(
            *self.view(points.places).T,
            s=size * (2.2 if hollow else 1),
            marker="o" if hollow else "^",
            facecolors="none" if hollow else colour,
            edgecolors=colour if hollow else "white",
            linewidths=1.0 if hollow else 0.4,
            zorder=3,
            label=_counted(name + "s", len(points.keys)),
            rasterized=len(points.keys) > _MANY,
        )

    def _start(self, axes: Any) -> Any:
        if not len(self.estimate.keys):
            return None
        first = self.view(self.estimate.places[:1])
        return axes.scatter(
            *first.T, s=42, color="white", edgecolors=style.INK, linewidths=1.3, zorder=4, label="start"
        )

    def _frame(self, axes: Any) -> None:
        """Equal axes in metres, around what is known; odometry may run out of the picture."""
        kept = [self.view(track.places) for track in (self.estimate, self.truth, self.points) if len(track.keys)]
        low, high = limits(
            np.concatenate(kept), self.view(self.odometry.places), beyond=0.0 if self.view.in_space else 0.12
        )
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_xlabel(self.view.labels[0])
        axes.set_ylabel(self.view.labels[1])
        if self.view.in_space:
            axes.set_zlim(low[2], high[2])
            axes.set_zlabel(self.view.labels[2])
            axes.set_box_aspect(high - low, zoom=1.2)
            axes.view_init(elev=22, azim=-58)
            for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
                axis.set_pane_color((1, 1, 1, 0))
        else:
            axes.set_aspect("equal", adjustable="box")


def _thinner(count: int) -> float:
    """Lines and marks get thinner where there are many."""
    return float(np.clip((4000 / max(count, 1)) ** 0.25, 0.35, 1.0))


def _counted(name: str, count: int, unit: str = "") -> str:
    return f"{name} ({count:,}{' ' + unit if unit else ''})" if count else name
