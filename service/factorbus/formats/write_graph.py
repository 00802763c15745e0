"""Write a graph into a file, in the form that its ending says."""

import os
from pathlib import Path

from factorbus.formats.errors import FormatError
from factorbus.formats.left_out import FileNotes, LeftOut
from factorbus.formats.robot_log import RobotLog
from factorbus.formats.write_g2o import write_g2o
from factorbus.formats.write_jrl import CBOR, write_jrl
from factorbus.formats.write_pyfg import write_pyfg
from factorbus.proto.messages import Batch

GRAPHS = (".g2o", ".pyfg", ".jrl", CBOR)  # CBOR: a JRL, coded so


def write_graph(
    path: str | os.PathLike[str], batch: Batch, strict: bool = False, ids: str = "auto", log: RobotLog | None = None
) -> FileNotes:
    """Write `batch`, and what a JRL has beside it; returns what was left out, for people.  Raises FormatError.

    ids: of a .g2o (`write_g2o`).  log: what is known beside the graph; only a JRL has a place for it.
    """
    ending = Path(path).suffix
    if ending not in GRAPHS:
        raise FormatError(str(path), None, f"the ending {ending!r}", f"one of {', '.join(GRAPHS)}")
    if ending in (".jrl", CBOR):
        return write_jrl(path, batch, strict, log)
    left = LeftOut(str(path), strict)
    if log is not None:
        beside = {
            "ground truth values": log.known,
            "potential outliers": log.potential_outliers,
            "outliers": log.outliers,
        }
        for name, count in beside.items():
            left.drop(name, count, f"{ending.removeprefix('.')} has no place to say so; the graph is whole")
    written = write_g2o(path, batch, strict, ids) if ending == ".g2o" else write_pyfg(path, batch, strict)
    return left.told().and_those(written)
