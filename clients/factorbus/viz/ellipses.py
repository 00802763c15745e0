"""Where a variable may be: 95 % ellipses of positions, from covariances of tangents.

The covariance of a pose is that of its tangent, which is local: δt is added as R δt, so positions have R Σ_tt Rᵀ in the
map (`proto/README.md`, §3).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Variables
from factorbus.viz import style
from factorbus.viz.geometry import POSITION, View

# Quantiles of χ² with two and three degrees of freedom at 95 %, as distances.
QUANTILE = {2: 2.447747, 3: 2.795483}
_CORNERS = 48


@dataclass(frozen=True, slots=True)
class Spread:
    """Positions (n, 3) and their covariances (n, 3, 3), in the map, m²; what lies in the plane has zeros in z."""

    keys: I64
    places: F64
    covariances: F64


def spread_of(variables: Sequence[Variables], blocks: Mapping[int, F64]) -> Spread:
    """From variables with values, and covariances (dim, dim) of the tangents of some of them, by key."""
    keys, places, spreads = [], [], []
    for group in variables:
        if group.kind not in POSITION or group.values is None:
            continue
        size = POSITION[group.kind]
        for key, value in zip(group.keys.tolist(), group.values, strict=True):
            block = blocks.get(key)
            if block is not None:
                turn, padded = _turn(group.kind, value), np.zeros((3, 3))
                padded[:size, :size] = turn @ np.asarray(block)[:size, :size] @ turn.T
                keys.append(key)
                places.append(np.pad(value[:size], (0, 3 - size)))
                spreads.append(padded)
    return Spread(np.array(keys, np.int64), np.array(places).reshape(-1, 3), np.array(spreads).reshape(-1, 3, 3))


def outlines(spread: Spread, view: View) -> F64:
    """Closed lines (k, corners, 2 or 3) around 95 %: one for each position in the plane, three in space."""
    turn = np.linspace(0, 2 * np.pi, _CORNERS)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    if view.in_space:
        values, axes = np.linalg.eigh(spread.covariances)
        roots = axes * np.sqrt(np.maximum(values, 0))[:, None, :] * QUANTILE[3]
        rings = [circle @ np.swapaxes(roots[:, :, pair], 1, 2) for pair in ((0, 1), (0, 2), (1, 2))]
        return np.concatenate([spread.places[:, None] + ring for ring in rings])
    values, axes = np.linalg.eigh(view.axes @ spread.covariances @ view.axes.T)
    roots = axes * np.sqrt(np.maximum(values, 0))[:, None, :] * QUANTILE[2]
    return view(spread.places)[:, None] + circle @ np.swapaxes(roots, 1, 2)


def draw_outlines(axes: Any, spread: Spread, view: View) -> Any:
    """Draw them; gives a handle for the legend, or None where there are none."""
    if not len(spread.keys):
        return None
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.lines import Line2D

    lines = outlines(spread, view)
    looks: dict[str, Any] = {"linewidths": 0.8, "alpha": 0.8, "zorder": 2.5}
    if view.in_space:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        axes.add_collection3d(Line3DCollection(list(lines), colors=style.SPREAD, **looks))
    else:
        axes.add_collection(PolyCollection(list(lines), facecolors=style.SPREAD, alpha=0.12, zorder=2.4), autolim=False)
        axes.add_collection(LineCollection(list(lines), colors=style.SPREAD, **looks), autolim=False)
    name = f"95 % of where it may be ({len(spread.keys):,})"
    return Line2D([], [], color=style.SPREAD, linewidth=1.2, label=name)


def _turn(kind: str, value: F64) -> F64:
    """R of a pose, or the identity of a point."""
    if kind == "se2":
        c, s = np.cos(value[2]), np.sin(value[2])
        return np.array([[c, -s], [s, c]])
    if kind in ("se3", "sim3"):
        x, y, z, w = value[3:7]
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
    return np.eye(POSITION[kind])
