"""The kinds of variables as the wire knows them: names and sizes.  A name never changes its meaning."""

from dataclasses import dataclass

from factorbus.wording import counted

POSE2 = "x y (metres), theta (radians)"
POSE3 = "x y z (metres), unit quaternion qx qy qz qw"
ROTATION = "unit quaternion qx qy qz qw"
SIMILARITY = POSE3 + ", scale"


@dataclass(frozen=True, slots=True)
class VariableKind:
    """One kind of variable: `size` numbers are stored and sent, `dim` is the size of its tangent space.

    quaternion_at: which of the numbers its quaternion begins with; −1: it has none.  scale_at: which is a scale
    """

    name: str
    size: int
    dim: int
    values: str
    is_pose: bool = False
    quaternion_at: int = -1
    scale_at: int = -1

    @property
    def is_vector(self) -> bool:
        """Whether it is plain numbers, which no frame moves."""
        return self.name.startswith("vector")


VARIABLE_KINDS = {
    kind.name: kind
    for kind in (
        VariableKind("se2", 3, 3, POSE2, is_pose=True),
        VariableKind("se3", 7, 6, POSE3, is_pose=True, quaternion_at=3),
        VariableKind("point2", 2, 2, "x y (metres)"),
        VariableKind("point3", 3, 3, "x y z (metres)"),
        VariableKind("idp", 6, 6, "x y z of the first camera (metres), theta, phi (radians), rho (1/metre)"),
        *(VariableKind(f"vector{n}", n, n, f"{counted(n, 'number')}, of any units") for n in range(1, 10)),
        VariableKind("so3", 4, 3, ROTATION, quaternion_at=0),
        VariableKind("sim3", 8, 7, SIMILARITY, is_pose=True, quaternion_at=3, scale_at=7),
    )
}
