"""Colours and letters of the pictures.  The colours differ for colour-blind readers as well."""

from typing import Any

ESTIMATE = "#0072B2"
ODOMETRY = "#E69F00"
TRUTH = "#9A9A9A"
LOOPS = "#AA3377"
POINTS = "#009E73"
SPREAD = "#56B4E9"
UNCERTAINTY = "#CC79A7"  # the same in live views, where sky blue is a loop closure that fits
INK = "#222222"
FAINT = "#E4E4E4"

SETTINGS: dict[Any, Any] = {
    "agg.path.chunksize": 20000,  # long tracks would exceed the renderer's cells
    "axes.axisbelow": True,
    "axes.edgecolor": "#BBBBBB",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "text.color": INK,
    "xtick.color": "#777777",
    "xtick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.color": "#777777",
    "ytick.labelcolor": INK,
    "ytick.labelsize": 8,
}
