"""The live view, in Rerun: the map as it moves, loop closures by how badly they fit, and plots of every step.

Everything is drawn in space; a map in the plane lies at z = 0 and is looked at from above.  Timelines: `revision`, and
`time`.
"""

import os
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from factorbus.proto.arrays import F64
from factorbus.proto.messages import Delta
from factorbus.proto.step_history import StepHistory
from factorbus.viz import style
from factorbus.viz.closures import closures_of, colours_of
from factorbus.viz.ellipses import outlines
from factorbus.viz.geometry import Track, feature_rays, points_of, segments_of, track_of, view_of
from factorbus.viz.map_follower import Look
from factorbus.viz.viewer_process import Viewer
from factorbus.wording import counted

_LETTER_BITS = 56
_POSITIONS_PER_S = 100_000  # what the whole map may add to a recording
_LINE, _THIN = rr.Radius.ui_points(1.2), rr.Radius.ui_points(0.6)
_PLOTS = {
    "chi2": ("χ²", style.ESTIMATE),
    "step_ms": ("time of a step (ms)", style.LOOPS),
    "eliminated": ("variables eliminated", style.POINTS),
    "changed": ("variables changed", style.ODOMETRY),
}


class LiveView:
    """A Rerun recording of a map, which goes to a file, to a viewer that is started here, or to browsers."""

    def __init__(self, map_name: str) -> None:
        self._map = map_name
        self._to = rr.RecordingStream("factorbus", recording_id=f"{map_name}-{os.urandom(4).hex()}")
        self._drawn_at, self._framed_m = -1e9, 0.0
        self._filled = (0, 0)  # epoch and revision up to which the plots have what the map's history said
        self._viewer: Viewer | None = None  # for browsers; a window of this display stays when we go

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything from now on into an .rrd file."""
        self._to.save(os.fspath(path), default_blueprint=_blueprint(self._map))
        self._name_plots()

    def spawn(self, data_port: int) -> None:
        """Start the viewer on this machine's display, or use the one that runs.  Raises RuntimeError, PortTaken."""
        self._connect(Viewer("127.0.0.1", data_port))

    def serve(self, host: str, web_port: int, data_port: int) -> str:
        """Serve to browsers at the address `host`; returns the page's address.

        Raises RuntimeError, PortTaken, CannotListen.
        """
        self._viewer = Viewer(host, data_port, web_port)
        self._connect(self._viewer)
        return self._viewer.page

    def _connect(self, viewer: Viewer) -> None:
        self._to.connect_grpc(viewer.data, default_blueprint=_blueprint(self._map))
        self._name_plots()

    def show(self, look: Look, last: bool = False) -> None:
        """Log every step, and the map as it is now, unless it is large, was drawn just before, and this is not last."""
        now = time.time()
        for delta in look.deltas:
            self._log_step(delta, now)
        track = track_of(look.variables)
        size = sum(len(group.keys) for group in look.variables)
        if last or now - self._drawn_at >= size / _POSITIONS_PER_S:
            self._drawn_at = now
            self._at(look.revision, now)
            self._log_map(look, track)
            self._frame(track)

    def show_history(self, history: StepHistory) -> None:
        """Fill the plots with the steps before we came; those steps are not logged again when their deltas come."""
        revisions = rr.TimeColumn("revision", sequence=history.revisions)
        for name in _PLOTS:
            numbers = np.asarray(getattr(history, name), np.float64)
            if len(numbers):
                self._to.send_columns(f"plots/{name}", [revisions], rr.Scalars.columns(scalars=numbers))
        self._filled = (history.epoch, history.revision)

    def close(self) -> None:
        """Hand over what is still here."""
        self._to.flush(timeout_sec=10.0)
        self._to.disconnect()
        if self._viewer is not None:
            self._viewer.stop()

    def _frame(self, track: Track) -> None:
        """Step back when the map has outgrown the picture, each time by so much that it is seldom."""
        if len(track.keys) > 1:
            size_m = float(np.ptp(track.places, axis=0).max())
            if size_m > 1.4 * self._framed_m:
                self._framed_m = size_m
                self._to.send_blueprint(_blueprint(self._map, track.places))

    def _at(self, revision: int, now: float) -> None:
        self._to.set_time("revision", sequence=revision)
        self._to.set_time("time", timestamp=now)

    def _log_step(self, delta: Delta, now: float) -> None:
        self._at(delta.revision, now)
        for name in _PLOTS if self._is_new(delta) else ():
            if name in delta.report:
                self._to.log(f"plots/{name}", rr.Scalars(float(delta.report[name])))
        if "strategy" in delta.report:  # that of a part of the map says less
            text = f"{delta.report.get('strategy', '')}: {delta.report.get('because', '')}"
            text += "; converging: further steps follow" if delta.report.get("converging") is True else ""
            if delta.report.get("complete") is False:
                deferred = counted(int(delta.report.get("deferred_relinearizations", 0)), "relinearization")
                text += f"; {deferred} and more left for later steps"
            far = delta.report.get("converged") is False
            self._to.log("log", rr.TextLog(text, level="WARN" if far else "INFO"))

    def _is_new(self, delta: Delta) -> bool:
        """Whether the plots do not have it yet."""
        epoch, revision = self._filled
        return delta.epoch != epoch or delta.revision > revision

    def _log_map(self, look: Look, track: Track) -> None:
        letters = track.keys >> _LETTER_BITS
        for letter in np.unique(letters).tolist():
            places = _in_space(track.places[letters == letter])
            name = chr(letter) if letter else "poses"
            self._to.log(f"map/trajectory/{name}", rr.LineStrips3D([places], colors=_rgb(style.ESTIMATE), radii=_LINE))
            robot = rr.Points3D(places[-1:], colors=_rgb(style.INK), radii=rr.Radius.ui_points(5), labels=[name])
            self._to.log(f"map/robot/{name}", robot)
        points = points_of(look.variables)
        landmarks = rr.Points3D(_in_space(points.places), colors=_rgb(style.POINTS), radii=rr.Radius.ui_points(3))
        self._to.log("map/landmarks", landmarks)
        touched = np.isin(track.keys, look.touched())
        last = rr.Points3D(
            _in_space(track.places[touched]), colors=_rgb(style.ODOMETRY), radii=rr.Radius.ui_points(2.5)
        )
        self._to.log("map/last_step", last)
        self._log_lines("map/rays", feature_rays(look.variables).places, _rgb(style.SPREAD))
        closures = closures_of(look.variables, look.factors)
        colours = (255 * colours_of(closures.misfit)).astype(np.uint8)
        known = np.isin(closures.keys, track.keys).all(axis=1)
        self._log_lines("map/loop_closures", segments_of(track, closures.keys), colours[known])
        if look.spread is not None:
            everything = track.places if len(track.keys) else points.places
            rings = outlines(look.spread, view_of(everything)) if len(look.spread.keys) else np.empty((0, 2, 3))
            self._log_lines("map/where_it_may_be", rings, _rgb(style.UNCERTAINTY), _THIN)

    def _log_lines(self, path: str, lines: F64, colours: object, width: Any = _LINE) -> None:
        """Line strips (n, corners, 2 or 3)."""
        strips = [_in_space(line) for line in lines]
        self._to.log(path, rr.LineStrips3D(strips, colors=colours, radii=width))  # type: ignore[arg-type]

    def _name_plots(self) -> None:
        for name, (title, colour) in _PLOTS.items():
            self._to.log(f"plots/{name}", rr.SeriesLines(colors=_rgb(colour), names=title, widths=1.5), static=True)


def _blueprint(name: str, places: F64 | None = None) -> rrb.Blueprint:
    """The map beside its plots; once there are places, the eye stands where it sees them."""
    plots = [rrb.TimeSeriesView(origin=f"/plots/{each}", name=title) for each, (title, _) in _PLOTS.items()]
    space = rrb.Spatial3DView(
        origin="/map",
        name=f"map {name}",
        background=rrb.Background(color=[255, 255, 255], kind=rrb.BackgroundKind.SolidColor),
        eye_controls=_eye(places) if places is not None else None,
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            space,
            rrb.Vertical(
                rrb.Grid(*plots, grid_columns=2), rrb.TextLogView(origin="/log", name="steps"), row_shares=[3, 1]
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="revision"),
        collapse_panels=True,
    )


def _eye(places: F64) -> rrb.EyeControls3D:
    """Above the middle, north up; a little from the side where the map fills space."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle = _in_space(((low + high) / 2)[None])[0]
    far = 1.3 * float((high - low).max()) + 1.0
    flat = not view_of(places).in_space
    away = np.array([0.0, -0.01, 1.0]) if flat else np.array([0.5, -0.9, 0.6])
    return rrb.EyeControls3D(position=middle + far * away, look_target=middle, eye_up=[0, 1, 0] if flat else [0, 0, 1])


def _in_space(places: F64) -> F64:
    return np.pad(places, ((0, 0), (0, 3 - places.shape[1])))


def _rgb(colour: str) -> Sequence[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
