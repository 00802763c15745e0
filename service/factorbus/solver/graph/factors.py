"""The kinds of factors.  A kind is a declaration; its residual and Jacobians are a kernel of the same name.  MATH §3.

Tests are run for every entry of `FACTOR_KINDS`: a new kind gets them by being declared.
"""

from dataclasses import dataclass

from factorbus.solver.graph.variables import IDP, POINT2, POINT3, SE2, SE3, VariableKind
from factorbus.solver.kernels.model import layout


@dataclass(frozen=True, slots=True)
class FactorKind:
    """One kind of factor: `size` numbers measured, a residual of `dim`, an information matrix dim × dim.

    name: the wire name, whose meaning never changes.  code: how kernels know it.
    """

    name: str
    code: int
    connects: tuple[VariableKind, ...]
    size: int
    dim: int
    measures: str
    equation: str

    @property
    def triangle(self) -> int:
        """Numbers in the upper triangle of the information matrix."""
        return self.dim * (self.dim + 1) // 2

    def __str__(self) -> str:
        return self.name


def _linear(*ends: VariableKind) -> FactorKind:
    """What is known of one variable, or of two together: of as many rows as the smaller has scalars."""
    names = [end.name for end in ends]
    of = names[:1] if len(ends) == 1 else ["pair", *dict.fromkeys(names)]
    name, rows = "_".join(["linear", *of]), min(end.dim for end in ends)
    size = sum(end.size + rows * end.dim for end in ends) + rows
    code = getattr(layout, name.upper())
    return FactorKind(name, code, ends, size, rows, "y, H, b" if len(ends) == 1 else "y₁ y₂, H₁ H₂, b", "MATH (3.26)")


FACTOR_KINDS = {
    kind.name: kind
    for kind in (
        FactorKind("prior_se2", layout.PRIOR_SE2, (SE2,), 3, 3, "the pose in the map", "MATH (3.1)"),
        FactorKind("prior_se3", layout.PRIOR_SE3, (SE3,), 7, 6, "the pose in the map", "MATH (3.5)"),
        FactorKind("prior_point2", layout.PRIOR_POINT2, (POINT2,), 2, 2, "the point in the map", "MATH (3.8)"),
        FactorKind("prior_point3", layout.PRIOR_POINT3, (POINT3,), 3, 3, "the point in the map", "MATH (3.8)"),
        FactorKind("between_se2", layout.BETWEEN_SE2, (SE2, SE2), 3, 3, "2nd pose in 1st's frame", "MATH (3.2)"),
        FactorKind("between_se3", layout.BETWEEN_SE3, (SE3, SE3), 7, 6, "2nd pose in 1st's frame", "MATH (3.6)"),
        FactorKind("landmark_se2", layout.LANDMARK_SE2, (SE2, POINT2), 2, 2, "point in pose's frame", "MATH (3.3)"),
        FactorKind("landmark_se3", layout.LANDMARK_SE3, (SE3, POINT3), 3, 3, "point in pose's frame", "MATH (3.7)"),
        FactorKind(
            "bearing_range_se2", layout.BEARING_RANGE_SE2, (SE2, POINT2), 2, 2, "(radians, metres)", "MATH (3.4)"
        ),
        FactorKind("idp_first", layout.IDP_FIRST, (SE3, IDP), 14, 6, "pixel, ρ₀, lens", "MATH (3.15)"),
        FactorKind("idp_seen", layout.IDP_SEEN, (SE3, IDP), 13, 2, "pixel, lens", "MATH (3.16)"),
        FactorKind("point_seen", layout.POINT_SEEN, (SE3, POINT3), 13, 2, "pixel, lens", "MATH (3.17)"),
        FactorKind("position_se2", layout.POSITION_SE2, (SE2,), 4, 2, "position in the map, lever", "MATH (3.20)"),
        FactorKind("position_se3", layout.POSITION_SE3, (SE3,), 6, 3, "position in the map, lever", "MATH (3.20)"),
        FactorKind("heading_se2", layout.HEADING_SE2, (SE2,), 1, 1, "heading in the map", "MATH (3.21)"),
        FactorKind("attitude_se3", layout.ATTITUDE_SE3, (SE3,), 6, 3, "direction, seen and in the map", "MATH (3.22)"),
        FactorKind("range_se2", layout.RANGE_SE2, (SE2, POINT2), 1, 1, "distance", "MATH (3.23)"),
        FactorKind("range_se3", layout.RANGE_SE3, (SE3, POINT3), 1, 1, "distance", "MATH (3.23)"),
        FactorKind("bearing_se2", layout.BEARING_SE2, (SE2, POINT2), 1, 1, "radians", "MATH (3.24)"),
        FactorKind("bearing_se3", layout.BEARING_SE3, (SE3, POINT3), 3, 3, "direction", "MATH (3.25)"),
        *(_linear(kind) for kind in (SE2, SE3, POINT2, POINT3, IDP)),
        *(_linear(kind, kind) for kind in (SE2, SE3, POINT2, POINT3, IDP)),
        *(_linear(*both) for both in ((SE2, POINT2), (SE3, POINT3), (SE3, IDP), (POINT3, IDP))),
    )
}
LENS_AT = {"idp_first": 3, "idp_seen": 2, "point_seen": 2}  # where in a measurement the code of its lens is
LOSSES = {
    "huber": layout.HUBER,
    "cauchy": layout.CAUCHY,
    "geman-mcclure": layout.GEMAN_MCCLURE,
    "tukey": layout.TUKEY,
    "dcs": layout.DCS,
}
LOSS_OF_CODE = {code: name for name, code in LOSSES.items()}
FACTOR_KIND_OF_CODE = {kind.code: kind for kind in FACTOR_KINDS.values()}
