"""What the wire says of one kind of factor.  The kinds themselves are in `kinds`."""

from dataclasses import dataclass

from factorbus.proto import inertial
from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.frames import moving_ends
from factorbus.proto.variable_kinds import VARIABLE_KINDS

LINEAR = "linear_"  # what the names of linear kinds begin with


@dataclass(frozen=True, slots=True)
class FactorKind:
    """One kind of factor: `size` numbers measured, a residual of `dim`, an information matrix dim × dim.

    measured, residual: for people, and for the table in proto/README.md.  There the variables are a and b of two poses,
    l of a point and y of a feature seen from pose a, m of a mount, and x, or x₁ and x₂, of others.
    example: a measurement, for the golden message of the kind
    half_angles: three rows of the residual are the vector part of a quaternion (`half_angle_rows`)
    own: of a kind that a client has written itself, what it is; its name is the formula
    base, modifiers: the kind that this is with further variables, one of each modifier (`derived_kinds`)
    roles: by variable, "" where it is a place in the map or numbers in no frame.  "mount": a pose in the robot's frame,
    which stays where the map moves.  "frame": the pose of the map in another frame.  "axes": a vector along the map's
    axes
    """

    name: str
    connects: tuple[str, ...]
    size: int
    dim: int
    measured: str
    residual: str
    example: tuple[float, ...]
    half_angles: bool = False
    base: str = ""
    modifiers: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()
    own: Declaration | None = None

    def __post_init__(self) -> None:
        if len(self.example) != self.size:
            raise ValueError(
                f"the factor kind {self.name!r} has the size {self.size}, and its example {len(self.example)}; "
                "give an example of a measurement"
            )

    @property
    def half_angle_rows(self) -> slice:
        """Which rows of the residual are the vector part of a quaternion: those behind a translation, if any."""
        first = 3 if self.dim > 3 else 0
        return slice(first, first + 3) if self.half_angles else slice(0)

    @property
    def information_size(self) -> int:
        """Numbers in the upper triangle of the information matrix, row by row."""
        return self.dim * (self.dim + 1) // 2

    @property
    def is_absolute(self) -> bool:
        """Whether it is known in the map's frame, and not of variables relative to each other."""
        if self.own:
            return moving_ends(self.own) is None
        of_length = self.roles == ("axes",)  # the same in every frame
        return len(self.connects) == 1 + len(self.modifiers) and "frame" not in self.modifiers and not of_length

    @property
    def is_linear(self) -> bool:
        """Whether it is a linear model of its variables."""
        return self.name.startswith(LINEAR)

    @property
    def called(self) -> str:
        """Its name, for people: of one's own kind what stands before its variables."""
        return self.own.name if self.own else self.name

    @property
    def each_role(self) -> tuple[str, ...]:
        """The role of each variable; of an own kind those are mounts that stay where all else is moved."""
        if self.own is None:
            return self.roles or ("",) * len(self.connects)
        moving = moving_ends(self.own) or ()
        on_robot = [
            bool(moving) and n not in moving and not VARIABLE_KINDS[end].is_vector
            for n, end in enumerate(self.connects)
        ]
        return tuple("mount" if stays else "" for stays in on_robot)

    @property
    def imu(self) -> inertial.ImuForm | None:
        """Of a kind that is of an IMU what it is."""
        return inertial.form_of_name(self.name) if self.name.startswith(inertial.PREFIX) else None

    @property
    def sees_landmark(self) -> bool:
        """Whether it connects a pose with a point or a feature."""
        ends = [VARIABLE_KINDS[end] for end in self.connects]
        if self.is_linear or self.own or ends[-1].is_vector:
            return False
        return [end.is_pose for end in ends] == [True, False]
