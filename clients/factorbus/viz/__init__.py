"""Pictures of maps.  Needs the extra `viz` (matplotlib), which is imported when the first picture is drawn."""

from factorbus.viz.drive import drive_figure
from factorbus.viz.ellipses import Spread, spread_of
from factorbus.viz.files import BadPicture, checked_ending, save
from factorbus.viz.history import DriveHistory
from factorbus.viz.odometry import Odometry, loops_of
from factorbus.viz.picture import MapLayers, map_figure, save_map
from factorbus.viz.sparsity import Pattern, sparsity_figure
from factorbus.viz.tree import tree_figure

__all__ = [
    "BadPicture",
    "DriveHistory",
    "MapLayers",
    "Odometry",
    "Pattern",
    "Spread",
    "checked_ending",
    "drive_figure",
    "loops_of",
    "map_figure",
    "save",
    "save_map",
    "sparsity_figure",
    "spread_of",
    "tree_figure",
]
