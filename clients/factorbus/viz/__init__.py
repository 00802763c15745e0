"""Pictures of maps.  Needs the extra `viz` (matplotlib), which is imported when the first picture is drawn."""

from factorbus.viz.course import Course
from factorbus.viz.odometry import Odometry, loops_of
from factorbus.viz.picture import BadPicture, map_figure, save_map

__all__ = ["BadPicture", "Course", "Odometry", "loops_of", "map_figure", "save_map"]
