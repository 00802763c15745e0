"""The kinds of variables and factors as the wire knows them: names, sizes and what connects to what.

The mathematics of each kind (residual, Jacobians, ⊞) is the solver's; this table is all a client needs to
build and read messages, and a test holds the two against each other.  A name never changes its meaning.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class VariableKind:
    """One kind of variable: `size` numbers are stored and sent, `dim` is the size of its tangent space."""

    name: str
    size: int
    dim: int
    values: str


@dataclass(frozen=True, slots=True)
class FactorKind:
    """One kind of factor: `size` numbers measured, a residual of `dim`, an information matrix dim × dim."""

    name: str
    connects: tuple[str, ...]
    size: int
    dim: int
    measured: str

    @property
    def information_size(self) -> int:
        """Numbers in the upper triangle of the information matrix, row by row."""
        return self.dim * (self.dim + 1) // 2


_POSE2 = "x y (metres), theta (radians)"
_POSE3 = "x y z (metres), unit quaternion qx qy qz qw"
_PIXEL = "u v (pixels)"
_LENS = "lens (11 numbers: `factorbus.proto.camera.Camera.lens`)"

# What a factor that is far off may count instead of r'Wr, by the name of the loss; its scale is in standard deviations.
LOSSES = ("huber", "cauchy", "geman-mcclure", "tukey", "dcs")

VARIABLE_KINDS = {
    kind.name: kind
    for kind in (
        VariableKind("se2", 3, 3, _POSE2),
        VariableKind("se3", 7, 6, _POSE3),
        VariableKind("point2", 2, 2, "x y (metres)"),
        VariableKind("point3", 3, 3, "x y z (metres)"),
        VariableKind("idp", 6, 6, "x y z of the first camera (metres), theta, phi (radians), rho (1/metre)"),
    )
}


def _linear(*ends: str) -> FactorKind:
    """What is known of one variable, or of two together: of as many rows as the smaller has scalars."""
    kinds = [VARIABLE_KINDS[end] for end in ends]
    name = "_".join(["linear", *(ends if len(ends) == 1 else ("pair", *dict.fromkeys(ends)))])
    rows = min(kind.dim for kind in kinds)
    values, blocks = sum(kind.size for kind in kinds), [f"{rows} x {kind.dim}" for kind in kinds]
    size = values + rows * sum(kind.dim for kind in kinds) + rows
    if len(ends) == 1:
        return FactorKind(name, ends, size, rows, f"y ({values}), H ({blocks[0]}), b ({rows})")
    of_both = f"2 x {blocks[0]}" if blocks[0] == blocks[1] else " and ".join(blocks)
    return FactorKind(name, ends, size, rows, f"y of both ({values}), H of both ({of_both}), b ({rows})")


FACTOR_KINDS = {
    kind.name: kind
    for kind in (
        FactorKind("prior_se2", ("se2",), 3, 3, _POSE2 + ", in the map"),
        FactorKind("prior_se3", ("se3",), 7, 6, _POSE3 + ", in the map"),
        FactorKind("prior_point2", ("point2",), 2, 2, "x y (metres), in the map"),
        FactorKind("prior_point3", ("point3",), 3, 3, "x y z (metres), in the map"),
        FactorKind("between_se2", ("se2", "se2"), 3, 3, _POSE2 + ": the second pose in the first one's frame"),
        FactorKind("between_se3", ("se3", "se3"), 7, 6, _POSE3 + ": the second pose in the first one's frame"),
        FactorKind("landmark_se2", ("se2", "point2"), 2, 2, "x y (metres): the point in the pose's frame"),
        FactorKind("landmark_se3", ("se3", "point3"), 3, 3, "x y z (metres): the point in the pose's frame"),
        FactorKind("bearing_range_se2", ("se2", "point2"), 2, 2, "bearing (radians), range (metres), from the pose"),
        FactorKind("idp_first", ("se3", "idp"), 14, 6, f"{_PIXEL}, rho (1/metre), {_LENS}"),
        FactorKind("idp_seen", ("se3", "idp"), 13, 2, f"{_PIXEL}, {_LENS}"),
        FactorKind("point_seen", ("se3", "point3"), 13, 2, f"{_PIXEL}, {_LENS}"),
        FactorKind("position_se2", ("se2",), 4, 2, "x y in the map, x y of the antenna on the robot (metres)"),
        FactorKind("position_se3", ("se3",), 6, 3, "x y z in the map, x y z of the antenna on the robot (metres)"),
        FactorKind("heading_se2", ("se2",), 1, 1, "theta in the map (radians)"),
        FactorKind(
            "attitude_se3", ("se3",), 6, 3, "a direction as the robot sees it, the same in the map (any length)"
        ),
        FactorKind("range_se2", ("se2", "point2"), 1, 1, "distance (metres)"),
        FactorKind("range_se3", ("se3", "point3"), 1, 1, "distance (metres)"),
        FactorKind("bearing_se2", ("se2", "point2"), 1, 1, "bearing (radians), from the pose"),
        FactorKind("bearing_se3", ("se3", "point3"), 3, 3, "direction from the pose (any length)"),
        *(_linear(kind) for kind in ("se2", "se3", "point2", "point3", "idp")),
        *(_linear(kind, kind) for kind in ("se2", "se3", "point2", "point3", "idp")),
        *(_linear(*b) for b in (("se2", "point2"), ("se3", "point3"), ("se3", "idp"), ("point3", "idp"))),
    )
}


@dataclass(frozen=True, slots=True)
class ChangeKind:
    """A change of what a map has: it names factors (by id) or variables (by key); `numbers`: its column, if any."""

    name: str
    names: str
    numbers: str = ""


CHANGES = {
    kind.name: kind
    for kind in (
        ChangeKind("remove_factors", "factors"),
        ChangeKind("remove_variables", "keys"),
        ChangeKind("loss", "factors", "scale"),
        ChangeKind("weigh", "factors", "weight"),
        ChangeKind("fix", "keys"),
        ChangeKind("free", "keys"),
        ChangeKind("place", "keys", "values"),
        ChangeKind("marginalise", "keys"),
    )
}
