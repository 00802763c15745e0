"""The picture of a camera among points: rays from above that shorten, and how their depths became known."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.viz import style
from factorbus.viz.files import checked_ending

_HORIZON_M = 25.0  # a ray whose end is not known is drawn up to here
_SIGMAS = 2.0

# Number of the frame, the camera's position (3,), features (n, 6), their σ_ρ (n,).
Frame = tuple[int, F64, F64, F64]


def save_monocular_drive(
    path: str | os.PathLike[str],
    frames: Sequence[Frame],
    truth: Sequence[F64],
    points: F64,
    shares: Sequence[Sequence[float]],
    subtitle: str,
) -> None:
    """Draw a drive into a .png, .svg or .pdf file.  Raises BadPicture, or OSError from the file.

    frames: number, camera position, features and spread of each.  truth: the camera's true positions.
    points (n, 3): true.  shares: for each feature σ_ρ/ρ frame by frame.  Lengths in metres; seen from above:
    x to the right, z up.
    """
    checked_ending(path)
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(style.SETTINGS):
        figure = Figure(figsize=(11.0, 8.2), layout="constrained")
        grid = figure.add_gridspec(2, 3, height_ratios=[1.0, 0.62])
        for column, frame in enumerate(_chosen(frames)):
            _draw_rays(figure.add_subplot(grid[0, column]), frame, truth, points)
        _draw_shares(figure.add_subplot(grid[1, :2]), shares)
        _draw_way(figure.add_subplot(grid[1, 2]), frames, truth)
        figure.suptitle("Rays become points", x=0.012, ha="left", fontsize=13)
        figure.text(0.012, 0.935, subtitle, fontsize=9.5, color="#555555")
        figure.savefig(path, dpi=150)


def _chosen(frames: Sequence[Frame]) -> list[Frame]:
    """The first frame, an early one, and the last."""
    return [frames[0], frames[min(len(frames) - 1, max(1, len(frames) // 10))], frames[-1]]


def _draw_rays(axes: Any, frame: Frame, truth: Sequence[F64], points: F64) -> None:
    """What of each ray lies within two standard deviations of its inverse distance."""
    from matplotlib.collections import LineCollection

    number, position, features, spread = frame
    axes.scatter(points[:, 0], points[:, 2], s=5, color=style.TRUTH, label="true point", zorder=1)
    near, far = (_depth(features[:, 5] + sign * _SIGMAS * spread) for sign in (1, -1))
    m = np.stack(
        [np.cos(features[:, 4]) * np.sin(features[:, 3]), np.cos(features[:, 4]) * np.cos(features[:, 3])], axis=1
    )
    anchors = features[:, [0, 2]]
    ends = np.stack([anchors + near[:, None] * m, anchors + far[:, None] * m], axis=1)
    axes.add_collection(LineCollection(list(ends), colors=style.ESTIMATE, linewidths=1.1, alpha=0.55, zorder=2))
    best = anchors + _depth(features[:, 5])[:, None] * m
    axes.scatter(best[:, 0], best[:, 1], s=8, color=style.POINTS, zorder=3)
    way = np.array(truth[: number + 1])
    axes.plot(way[:, 0], way[:, 2], color=style.INK, linewidth=1.2, zorder=4)
    axes.scatter(position[0], position[2], s=26, marker="^", color=style.LOOPS, zorder=5)
    axes.set(xlim=(-9, 9), ylim=(-1, 17), aspect="equal", xlabel="x, m", ylabel="z, m")
    axes.set_title(f"frame {number}", loc="left")


def _depth(rho: F64) -> F64:
    """Metres, up to the horizon; whatever has no end is as far as that."""
    with np.errstate(divide="ignore"):
        return np.where(rho > 1 / _HORIZON_M, 1 / rho, _HORIZON_M)


def _draw_shares(axes: Any, shares: Sequence[Sequence[float]]) -> None:
    for share in shares:
        axes.plot(np.arange(len(share)), share, color=style.ESTIMATE, linewidth=0.6, alpha=0.35)
    if shares:
        longest = max(map(len, shares))
        median = [np.median([s[k] for s in shares if len(s) > k]) for k in range(longest)]
        axes.plot(np.arange(longest), median, color=style.LOOPS, linewidth=1.8, label="median")
        axes.legend()
    axes.set(yscale="log", xlabel="frames since first observation", ylabel="σ of inverse depth / inverse depth")


def _draw_way(axes: Any, frames: Sequence[Frame], truth: Sequence[F64]) -> None:
    way, true = np.array([frame[1] for frame in frames]), np.array(truth)
    axes.plot(true[:, 0], true[:, 2], color=style.TRUTH, linewidth=3, alpha=0.6, label="truth")
    axes.plot(way[:, 0], way[:, 2], color=style.ESTIMATE, linewidth=1.2, label="filter")
    axes.set(aspect="equal", xlabel="x, m", ylabel="z, m", title="the camera's way")
    axes.legend()
