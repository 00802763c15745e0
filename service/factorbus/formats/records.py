"""The records of each dialect: name, what follows it, and which kind of variable or factor it is.

Information is an upper triangle row by row in the order of the measurement, unless a record says otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.wording import counted

_TORO_ORDER = (0, 1, 4, 2, 5, 3)  # the file has xx xy yy tt xt yt; (xx, xy, xt, yy, yt, tt) are at these places


@dataclass(frozen=True, slots=True)
class Vertex:
    """A record `NAME id values` of a variable of `kind`."""

    kind: str

    @property
    def ids(self) -> int:
        return 1

    @property
    def width(self) -> int:
        return 1 + VARIABLE_KINDS[self.kind].size

    @property
    def fields(self) -> str:
        return f"id and {counted(self.width - 1, 'number')} ({VARIABLE_KINDS[self.kind].values})"


@dataclass(frozen=True, slots=True)
class Edge:
    """A record `NAME ids [parameters] [lead] measurement weight` of a factor of `kind`.

    parameters: how many numbers of offsets (PARAMS_SE2OFFSET, PARAMS_SE3OFFSET) stand after the ids; optional: they
    may be left out; applied: whether g2o applies them, which it does not in every record.
    lead: what one number before the measurement is, "switch" or "mixture".  sized: how many numbers
    are measured in the file, where that is not the kind's own size.  extra: one more number may stand at the end, as
    RTAB-Map writes it.  order: where each number of the upper triangle is found.  weight: "information"; "root" (the
    upper triangular R of information RᵀR); "sigmas" (standard deviations); "euler_root" (R of x y z and roll pitch
    yaw, and the measurement has these angles too).
    """

    kind: str
    parameters: int = 0
    optional: bool = False
    applied: bool = True
    lead: str = ""
    sized: int = 0
    extra: bool = False
    order: tuple[int, ...] | None = None
    weight: str = "information"

    @property
    def ids(self) -> int:
        return len(FACTOR_KINDS[self.kind].connects)

    @property
    def measured(self) -> int:
        if self.weight == "euler_root":
            return FACTOR_KINDS[self.kind].dim
        return self.sized or FACTOR_KINDS[self.kind].size

    @property
    def weights(self) -> int:
        kind = FACTOR_KINDS[self.kind]
        return kind.dim if self.weight == "sigmas" else kind.information_size

    @property
    def width(self) -> int:
        return self.ids + self.parameters + bool(self.lead) + self.measured + self.weights

    @property
    def fields(self) -> str:
        ids = "id" if self.parameters == 1 else "ids"
        offset = f", the {ids} of {counted(self.parameters, 'offset')}" if self.parameters else ""
        lead = {"switch": ", the id of its switch", "mixture": ", the weight of its null hypothesis"}.get(self.lead, "")
        what = {"sigmas": "standard deviations"}.get(self.weight, "information")
        measured = f"{counted(self.measured, 'number')} measured"
        return f"{counted(self.ids, 'id')}{offset}{lead}, {measured}, {self.weights} of {what}"


@dataclass(frozen=True, slots=True)
class Dialect:
    """One way of writing graphs.

    one_numbering: poses and points share their ids.  others: records that are read but are neither variable nor factor.
    unspoken: records known and left out on purpose, with the note they leave.  refused: records that cannot be left
    out without making another graph of the file, with the reason.
    """

    name: str
    vertices: Mapping[str, Vertex]
    edges: Mapping[str, Edge]
    one_numbering: bool = True
    others: tuple[str, ...] = ()
    unspoken: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.vertices, *self.edges, *self.others)


OFFSETS = {"PARAMS_SE2OFFSET": "se2", "PARAMS_SE3OFFSET": "se3"}
SWITCH_PRIOR = "EDGE_SWITCH_PRIOR"
FIX = "FIX"
_POSITION_SE2 = Edge("position_se2", sized=2)
_POSITION_SE3 = Edge("position_se3", sized=3, parameters=1, optional=True, applied=False)
_PRIOR_SE3 = Edge("prior_se3", parameters=1, optional=True)

# The first record of a kind is the one that is written; the others are names that other programs give to the same.
G2O = Dialect(
    "g2o",
    vertices={
        "VERTEX_SE2": Vertex("se2"),
        "VERTEX_XY": Vertex("point2"),
        "VERTEX_SE3:QUAT": Vertex("se3"),
        "VERTEX_TRACKXYZ": Vertex("point3"),
    },
    edges={
        "EDGE_SE2": Edge("between_se2", extra=True),
        "EDGE_SE2_XY": Edge("landmark_se2", extra=True),
        "EDGE_SE3:QUAT": Edge("between_se3", extra=True),
        "EDGE_SE3_TRACKXYZ": Edge("landmark_se3", parameters=1, extra=True),
        "EDGE_PRIOR_SE2": Edge("prior_se2"),
        "EDGE_SE3_PRIOR": _PRIOR_SE3,
        "EDGE_PRIOR_XY": Edge("prior_point2"),
        "EDGE_POINTXYZ_PRIOR": Edge("prior_point3"),
        "EDGE_BEARING_SE2_XY": Edge("bearing_se2"),
        "EDGE_PRIOR_SE2_XY": _POSITION_SE2,
        "EDGE_SE3_XYZ_PRIOR": _POSITION_SE3,
        "EDGE_SE2_OFFSET": Edge("between_se2", parameters=2),
        "EDGE_SE3_OFFSET": Edge("between_se3", parameters=2),
        "EDGE_SE2_POINTXY_OFFSET": Edge("landmark_se2", parameters=1, applied=False),
        "EDGE_SE3": Edge("between_se3", extra=True),  # RTAB-Map, of landmarks with an orientation
        "EDGE_POINTXY_PRIOR": Edge("prior_point2"),
        "EDGE_SE2_PRIOR": Edge("prior_se2"),
        "EDGE_PRIOR_SE3:QUAT": _PRIOR_SE3,
        "EDGE_PRIOR_SE3_QUAT": _PRIOR_SE3,
        "EDGE_SE3_PRIORXYZ": _POSITION_SE3,  # hdl_graph_slam
        "EDGE_SE2_SWITCHABLE": Edge("between_se2", lead="switch"),  # Vertigo, and RTAB-Map with it
        "EDGE_SE3_SWITCHABLE": Edge("between_se3", lead="switch"),
        "EDGE_SE3:QUAT_SWITCHABLE": Edge("between_se3", lead="switch"),
        "EDGE_SE2_MAXMIX": Edge("between_se2", lead="mixture"),
        "EDGE_SE3_MAXMIX": Edge("between_se3", lead="mixture"),
        "EDGE_SE3:QUAT_MAXMIX": Edge("between_se3", lead="mixture"),
    },
    others=(FIX, *OFFSETS),
)

_TORO_3D = "readers of 3D TORO files do not agree on the order of the information; convert the file to g2o"
_SLAMPP_3D = "SLAM++ weighs the rotation of a 3D edge in its own parameters; convert the file to g2o"

TORO = Dialect(
    "toro",
    vertices={"VERTEX2": Vertex("se2"), "VERTEX": Vertex("se2")},
    edges={
        "EDGE2": Edge("between_se2", order=_TORO_ORDER),
        "EDGE": Edge("between_se2", order=_TORO_ORDER),
        "BR": Edge("bearing_range_se2", weight="sigmas"),
    },
    unspoken={"EQUIV": "EQUIV lines left out: equal poses stay joined by their edges"},
    refused={"VERTEX3": _TORO_3D, "EDGE3": _TORO_3D},
)

ISAM = Dialect(
    "isam",
    vertices={},
    edges={
        "ODOMETRY": Edge("between_se2", weight="root"),
        "EDGE2": Edge("between_se2", weight="root"),
        "LANDMARK": Edge("landmark_se2", weight="root"),
        "EDGE3": Edge("between_se3", weight="euler_root"),
    },
    one_numbering=False,
)

# Its parser has g2o's names of the plane, too, with the same numbers; vertices of points and FIX come with mixtures.
SLAMPP = Dialect(
    "slam++",
    vertices={
        "VERTEX2": Vertex("se2"),
        "VERTEX": Vertex("se2"),
        "VERTEX_SE2": Vertex("se2"),
        "VERTEX_XY": Vertex("point2"),
    },
    edges={
        "ODOMETRY": Edge("between_se2"),
        "EDGE2": Edge("between_se2"),
        "EDGE": Edge("between_se2"),
        "EDGE_SE2": Edge("between_se2"),
        "LANDMARK": Edge("landmark_se2"),
        "LANDMARK2": Edge("landmark_se2"),
        "LANDMARK2:XY": Edge("landmark_se2"),
        "EDGE_SE2_XY": Edge("landmark_se2"),
    },
    others=(FIX,),
    refused={"EDGE3": _SLAMPP_3D, "EDGE3:AXISANGLE": _SLAMPP_3D},
)

DIALECTS = {dialect.name: dialect for dialect in (G2O, TORO, ISAM, SLAMPP)}
