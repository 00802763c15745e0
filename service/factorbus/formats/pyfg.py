"""The records of PyFactorGraph's text files (.pyfg), of range-aided SLAM.

    VERTEX_SE2 time name x y theta                      VERTEX_SE3:QUAT time name x y z qx qy qz qw
    VERTEX_XY name x y                                  VERTEX_XYZ name x y z
    VERTEX_SE2:PRIOR time name measured covariance      and so on of the other vertices
    EDGE_SE2 time name name measured covariance         EDGE_SE3:QUAT, EDGE_SE2_XY, EDGE_SE3_XYZ
    EDGE_RANGE time name name distance variance         between a pose and a point, or two poses

A name is a letter and a number: A is a robot, L a landmark.  Times are in seconds, rotations and their covariances in
radians.  A covariance is an upper triangle row by row.  A file without times has 0 for each.
"""

from dataclasses import dataclass

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.wording import counted

PYFG = "pyfg"


@dataclass(frozen=True, slots=True)
class Record:
    """A record `NAME [time] names numbers`, with as many of these as it says."""

    kind: str
    names: int
    numbers: int
    fields: str
    timed: bool = True

    @property
    def width(self) -> int:
        return self.timed + self.names + self.numbers


def _vertex(kind: str) -> Record:
    of = VARIABLE_KINDS[kind]
    fields = f"{'time, ' if of.is_pose else ''}name and {counted(of.size, 'number')} ({of.values})"
    return Record(kind, 1, of.size, fields, timed=of.is_pose)


def _factor(kind: str) -> Record:
    of = FACTOR_KINDS[kind]
    names = counted(len(of.connects), "name")
    fields = f"time, {names}, {counted(of.size, 'number')} measured, {of.information_size} of covariance"
    return Record(kind, len(of.connects), of.size + of.information_size, fields)


VERTICES = {
    "VERTEX_SE2": _vertex("se2"),
    "VERTEX_SE3:QUAT": _vertex("se3"),
    "VERTEX_XY": _vertex("point2"),
    "VERTEX_XYZ": _vertex("point3"),
}
RANGE = "EDGE_RANGE"
FACTORS = {
    "VERTEX_SE2:PRIOR": _factor("prior_se2"),
    "VERTEX_SE3:QUAT:PRIOR": _factor("prior_se3"),
    "VERTEX_XY:PRIOR": _factor("prior_point2"),
    "VERTEX_XYZ:PRIOR": _factor("prior_point3"),
    "EDGE_SE2": _factor("between_se2"),
    "EDGE_SE3:QUAT": _factor("between_se3"),
    "EDGE_SE2_XY": _factor("landmark_se2"),
    "EDGE_SE3_XYZ": _factor("landmark_se3"),
    RANGE: _factor("range_se2"),  # or another range: its ends decide
}
# The factor that a range between two kinds of variables is.
RANGES = {
    FACTOR_KINDS[kind].connects: kind for kind in ("range_se2", "range_se3", "range_between_se2", "range_between_se3")
}
RECORDS = VERTICES | FACTORS
