"""Graph files in and out: g2o, TORO, iSAM, SLAM++, PyFactorGraph, JRL and TUM text, GLIM's maps and the poses of
COLMAP's models and of nuScenes are read, g2o, PyFactorGraph, JRL, TUM and KITTI are written.

`read` gives a `GraphFile`: the whole graph as one `Batch`, and its replay as one `Batch` a pose, in time order.
"""

from factorbus.formats.errors import FormatError
from factorbus.formats.graph import GraphFile
from factorbus.formats.left_out import FileNotes
from factorbus.formats.loop_list import with_loops
from factorbus.formats.numbering import IDS
from factorbus.formats.read_glim import is_glim
from factorbus.formats.reader import READS, read
from factorbus.formats.robot_log import FactorLabels, RobotLog
from factorbus.formats.steps import Steps
from factorbus.formats.whole_file import write_whole
from factorbus.formats.writable import Written
from factorbus.formats.write_g2o import as_g2o, g2o_text, write_g2o
from factorbus.formats.write_graph import GRAPHS, write_graph
from factorbus.formats.write_jrl import as_jrl, recoded, write_jrl
from factorbus.formats.write_kitti import kitti_text, write_kitti
from factorbus.formats.write_pyfg import as_pyfg, write_pyfg
from factorbus.formats.write_tum import tum_notes, tum_text, write_tum

__all__ = [
    "GRAPHS",
    "IDS",
    "READS",
    "FactorLabels",
    "FileNotes",
    "FormatError",
    "GraphFile",
    "RobotLog",
    "Steps",
    "Written",
    "as_g2o",
    "as_jrl",
    "as_pyfg",
    "g2o_text",
    "is_glim",
    "kitti_text",
    "read",
    "recoded",
    "tum_notes",
    "tum_text",
    "with_loops",
    "write_g2o",
    "write_graph",
    "write_jrl",
    "write_kitti",
    "write_pyfg",
    "write_tum",
    "write_whole",
]
