"""The kinds of variables as the wire knows them: names and sizes.  A name never changes its meaning."""

from dataclasses import dataclass
from typing import NamedTuple

from factorbus.wording import counted

POSE2 = "x y (metres), theta (radians)"
POSE3 = "x y z (metres), unit quaternion qx qy qz qw"
ROTATION = "unit quaternion qx qy qz qw"
SIMILARITY = POSE3 + ", scale"


class TangentScalar(NamedTuple):
    """One number of a tangent space: in which order they are, rows and columns of covariances have them.

    unit: "m", "rad", "1/m", "" of a ratio; None: that of the variable's maker.
    """

    name: str
    unit: str | None


_X, _Y, _Z = (TangentScalar(name, "m") for name in "xyz")
_TURN2 = TangentScalar("theta", "rad")
_TURN3 = tuple(TangentScalar(f"r{axis}", "rad") for axis in "xyz")  # a rotation vector
_IN_UNITS = tuple(TangentScalar(axis, "of its scale") for axis in "xyz")  # of a similarity
_NUMBERS = [TangentScalar(f"[{n}]", None) for n in range(9)]
_FEATURE = (TangentScalar("theta", "rad"), TangentScalar("phi", "rad"), TangentScalar("rho", "1/m"))


@dataclass(frozen=True, slots=True)
class VariableKind:
    """One kind of variable: `size` numbers are stored and sent.

    quaternion_at: which of the numbers its quaternion begins with; −1: it has none.  scale_at: which is a scale.
    tangent (dim,): what the scalars of its tangent space are: of poses along the axes of the robot
    """

    name: str
    size: int
    values: str
    tangent: tuple[TangentScalar, ...]
    is_pose: bool = False
    quaternion_at: int = -1
    scale_at: int = -1

    @property
    def dim(self) -> int:
        """The size of its tangent space."""
        return len(self.tangent)

    @property
    def is_vector(self) -> bool:
        """Whether it is plain numbers, which no frame moves."""
        return self.name.startswith("vector")


VARIABLE_KINDS = {
    kind.name: kind
    for kind in (
        VariableKind("se2", 3, POSE2, (_X, _Y, _TURN2), is_pose=True),
        VariableKind("se3", 7, POSE3, (_X, _Y, _Z, *_TURN3), is_pose=True, quaternion_at=3),
        VariableKind("point2", 2, "x y (metres)", (_X, _Y)),
        VariableKind("point3", 3, "x y z (metres)", (_X, _Y, _Z)),
        VariableKind(
            "idp", 6, "x y z of the first camera (metres), theta, phi (radians), rho (1/metre)", (_X, _Y, _Z, *_FEATURE)
        ),
        *(
            VariableKind(f"vector{n}", n, f"{counted(n, 'number')}, of any units", tuple(_NUMBERS[:n]))
            for n in range(1, 10)
        ),
        VariableKind("so3", 4, ROTATION, _TURN3, quaternion_at=0),
        VariableKind(
            "sim3", 8, SIMILARITY, (*_IN_UNITS, *_TURN3, TangentScalar("log scale", "")),
            is_pose=True, quaternion_at=3, scale_at=7,
        ),
    )
}  # fmt: skip
