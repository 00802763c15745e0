"""The records of each dialect: name, what follows it, and which kind of variable or factor it is.

Information is an upper triangle row by row in the order of the measurement, unless a record says otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS

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
        return f"id and {self.width - 1} numbers ({VARIABLE_KINDS[self.kind].values})"


@dataclass(frozen=True, slots=True)
class Edge:
    """A record `NAME ids [parameter] measurement weight` of a factor of `kind`.

    offset: the number of a PARAMS_SE3OFFSET stands after the ids.  order: where each number of the upper triangle
    is found.  weight: "information"; "root" (the upper triangular R of information RᵀR); "sigmas" (standard
    deviations); "euler_root" (R of x y z and roll pitch yaw, and the measurement has these angles too).
    """

    kind: str
    offset: bool = False
    order: tuple[int, ...] | None = None
    weight: str = "information"

    @property
    def ids(self) -> int:
        return len(FACTOR_KINDS[self.kind].connects)

    @property
    def measured(self) -> int:
        return FACTOR_KINDS[self.kind].dim if self.weight == "euler_root" else FACTOR_KINDS[self.kind].size

    @property
    def weights(self) -> int:
        kind = FACTOR_KINDS[self.kind]
        return kind.dim if self.weight == "sigmas" else kind.information_size

    @property
    def width(self) -> int:
        return self.ids + self.offset + self.measured + self.weights

    @property
    def fields(self) -> str:
        offset = ", the id of its PARAMS_SE3OFFSET" if self.offset else ""
        what = {"sigmas": "standard deviations"}.get(self.weight, "information")
        return f"{self.ids} id(s){offset}, {self.measured} numbers measured, {self.weights} of {what}"


@dataclass(frozen=True, slots=True)
class Dialect:
    """One way of writing graphs.

    one_numbering: poses and points share their ids.  unspoken: records known and left out on purpose, with the note
    they leave.  refused: records known to be unreadable here, with the reason.
    """

    name: str
    vertices: Mapping[str, Vertex]
    edges: Mapping[str, Edge]
    one_numbering: bool = True
    unspoken: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        fixes = ("FIX", "PARAMS_SE3OFFSET") if self.name == "g2o" else ()
        return (*self.vertices, *self.edges, *fixes)


G2O = Dialect(
    "g2o",
    vertices={
        "VERTEX_SE2": Vertex("se2"),
        "VERTEX_XY": Vertex("point2"),
        "VERTEX_SE3:QUAT": Vertex("se3"),
        "VERTEX_TRACKXYZ": Vertex("point3"),
    },
    edges={
        "EDGE_SE2": Edge("between_se2"),
        "EDGE_SE2_XY": Edge("landmark_se2"),
        "EDGE_SE3:QUAT": Edge("between_se3"),
        "EDGE_SE3_TRACKXYZ": Edge("landmark_se3", offset=True),
        "EDGE_PRIOR_SE2": Edge("prior_se2"),
        "EDGE_SE3_PRIOR": Edge("prior_se3", offset=True),
        "EDGE_POINTXYZ_PRIOR": Edge("prior_point3"),
    },
    refused={
        "EDGE_PRIOR_SE2_XY": "a prior on the x and y of a pose without its angle is no factor kind here",
        "EDGE_BEARING_SE2_XY": "a bearing without a range is no factor kind here",
        "EDGE_SE3_XYZ_PRIOR": "a prior on the position of a pose without its rotation is no factor kind here",
    },
)

_TORO_3D = "readers of 3D TORO files do not agree on the order of the information; convert the file to g2o"

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

DIALECTS = {dialect.name: dialect for dialect in (G2O, TORO, ISAM)}
