"""The kinds of variables and factors as the wire knows them: names, sizes and what connects to what.

The mathematics of each kind (residual, Jacobians, ⊞) is the solver's; this table is all a client needs to
build and read messages, and a test holds the two against each other.  A name never changes its meaning.
"""

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from factorbus.proto import inertial
from factorbus.wording import counted


@dataclass(frozen=True, slots=True)
class VariableKind:
    """One kind of variable: `size` numbers are stored and sent, `dim` is the size of its tangent space."""

    name: str
    size: int
    dim: int
    values: str
    is_pose: bool = False

    @property
    def is_vector(self) -> bool:
        """Whether it is plain numbers, which no frame moves."""
        return self.name.startswith("vector")


@dataclass(frozen=True, slots=True)
class FactorKind:
    """One kind of factor: `size` numbers measured, a residual of `dim`, an information matrix dim × dim.

    measured, residual: for people, and for the table in proto/README.md.  There the variables are a and b of two poses,
    l of a point and y of a feature seen from pose a, m of a mount, and x, or x₁ and x₂, of others.
    example: a measurement, for the golden message of the kind
    half_angles: the last three rows of the residual are the vector part of a quaternion
    base: the kind that this is with the pose of a sensor, whose mount on the robot is the last variable
    roles: by variable, "axes" of a vector along the map's axes, which turns with the map, and "" of others
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
    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.example) != self.size:
            raise ValueError(
                f"the factor kind {self.name!r} has the size {self.size}, and its example {len(self.example)}; "
                "give an example of a measurement"
            )

    @property
    def information_size(self) -> int:
        """Numbers in the upper triangle of the information matrix, row by row."""
        return self.dim * (self.dim + 1) // 2

    @property
    def is_absolute(self) -> bool:
        """Whether it is known in the map's frame, and not of variables relative to each other."""
        return len(self.connects) == 1

    @property
    def is_linear(self) -> bool:
        """Whether it is a linear model of its variables."""
        return self.name.startswith(_LINEAR)

    @property
    def samples(self) -> int:
        """How many samples of an IMU it has; 0: it is of no IMU."""
        return inertial.samples_of(self.name) if self.name.startswith(inertial.PREFIX) else 0

    @property
    def sees_landmark(self) -> bool:
        """Whether it connects a pose with what is no pose."""
        return not self.is_linear and [VARIABLE_KINDS[end].is_pose for end in self.connects] == [True, False]


_POSE2 = "x y (metres), theta (radians)"
_POSE3 = "x y z (metres), unit quaternion qx qy qz qw"
_PIXEL = "u v (pixels)"
_RADTAN = (1.0, 400.0, 401.0, 320.0, 240.0, 0.0, -0.25, 0.125, 0.001, -0.002, 0.0)
_LENS = "lens (11 numbers: `factorbus.proto.camera.Camera.lens`)"

# What a factor that is far off may count instead of r'Wr, by the name of the loss; its scale is in standard deviations.
LOSSES = ("huber", "cauchy", "geman-mcclure", "tukey", "dcs")

VARIABLE_KINDS = {
    kind.name: kind
    for kind in (
        VariableKind("se2", 3, 3, _POSE2, is_pose=True),
        VariableKind("se3", 7, 6, _POSE3, is_pose=True),
        VariableKind("point2", 2, 2, "x y (metres)"),
        VariableKind("point3", 3, 3, "x y z (metres)"),
        VariableKind("idp", 6, 6, "x y z of the first camera (metres), theta, phi (radians), rho (1/metre)"),
        *(VariableKind(f"vector{n}", n, n, f"{counted(n, 'number')}, of any units") for n in range(1, 10)),
    )
}


# The most variables of a linear factor; it has as many rows as they have scalars, and one more, at most.
MOST_JOINED = 128
LINEAR_NAME = "linear_ROWS_KIND_KIND..."
_LINEAR = "linear_"
_LONGEST = len("linear_1000") + MOST_JOINED * len("_vector9")  # characters of such a name
_LINEAR_FORM = re.compile(r"linear_([1-9][0-9]{0,3})((?:_[a-z0-9]+)+)")


def linear_kind(rows: int, ends: tuple[str, ...]) -> FactorKind:
    """The kind of linear factors with these rows and kinds of variables.

    Raises ValueError: no such kind of variable, or too many rows or variables.
    """
    if unknown := [end for end in ends if end not in VARIABLE_KINDS]:
        raise ValueError(f"{unknown[0]!r} is no kind of variable; wanted {', '.join(VARIABLE_KINDS)}")
    kinds = [VARIABLE_KINDS[end] for end in ends]
    values, scalars = sum(kind.size for kind in kinds), sum(kind.dim for kind in kinds)
    if not (1 <= len(ends) <= MOST_JOINED and 1 <= rows <= scalars + 1):
        raise ValueError(
            f"{counted(rows, 'row')} on {counted(len(ends), 'variable')}; wanted 1 to {MOST_JOINED} variables, and "
            f"a row for each of their scalars, and one more: 1 to {scalars + 1}"
        )
    size = values + rows * scalars + rows
    y = [number for kind in kinds for number in (*[0.0] * (kind.size - 1), 1.0)]
    measured = f"y of each variable ({values}), H of each ({rows} x its scalars, row by row), b ({rows})"
    name = "_".join(["linear", str(rows), *ends])
    return FactorKind(name, ends, size, rows, measured, "Σ Hₙ (xₙ ⊟ yₙ) + b", (*y, *[0.25] * (size - values)))


@lru_cache(maxsize=1024)
def imu_kind(samples: int) -> FactorKind:
    """The kind of inertial factors with that many samples.  Raises ValueError: none, or too many."""
    name, example = inertial.name_of(samples), (*inertial.EXAMPLE, *inertial.EXAMPLE_SAMPLE * samples)
    texts = inertial.MEASURED, inertial.DIFFERENCE
    return FactorKind(name, inertial.ENDS, len(example), inertial.RESIDUAL, *texts, example, roles=inertial.ROLES)


def _of_name(name: str) -> FactorKind | None:
    """The linear or inertial kind of that name; None: there is none."""
    if not name.startswith(inertial.PREFIX):
        return _linear_of_name(name)
    try:
        return imu_kind(inertial.samples_of(name))
    except ValueError:
        return None


def _linear_of_name(name: str) -> FactorKind | None:
    """The linear kind of that name; None: there is none."""
    if not name.startswith(_LINEAR) or len(name) > _LONGEST:
        return None
    try:
        return _read_linear(name)
    except ValueError:
        return None


@lru_cache(maxsize=1024)
def _read_linear(name: str) -> FactorKind:
    """Raises ValueError: why there is no linear kind of that name."""
    if (found := _LINEAR_FORM.fullmatch(name)) is None:
        raise ValueError("wanted a number of rows from 1 on, and the kind of each variable")
    return linear_kind(int(found[1]), tuple(found[2][1:].split("_")))


class FactorKinds(dict[str, FactorKind]):
    """The kinds by name.  Those of linear factors, one for any rows and variables, and of inertial factors, one for any
    number of samples, are found by name as well, and are not among the entries."""

    def __missing__(self, name: str) -> FactorKind:
        if (kind := _of_name(name)) is None:
            raise KeyError(name)
        return kind

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or (isinstance(name, str) and _of_name(name) is not None)

    def get(self, name: str, default: Any = None) -> Any:
        """The kind of that name, or `default`."""
        found = super().get(name)
        return found or _of_name(name) or default

    def names(self, unknown: str = "") -> tuple[str, ...]:
        """For a person: all names, and the forms of those of linear and inertial factors.

        Of an `unknown` one that begins as these do, what is wrong with it.
        """
        if unknown.startswith(_LINEAR) and len(unknown) > _LONGEST:
            return (f"{LINEAR_NAME}, of up to {MOST_JOINED} variables",)
        for prefix, form, read in (
            (_LINEAR, LINEAR_NAME, _read_linear),
            (inertial.PREFIX, inertial.NAME, inertial.samples_of),
        ):
            if unknown.startswith(prefix):
                try:
                    read(unknown)
                except ValueError as why:
                    return (f"{form} ({why})",)
        return (*self, LINEAR_NAME, inertial.NAME)


_WITH_MOUNT = (
    *("between_se2", "between_se3", "landmark_se2", "landmark_se3", "bearing_range_se2", "bearing_se2", "bearing_se3"),
    *("range_se2", "range_se3", "point_seen"),
)


def _with_mount(kind: FactorKind) -> FactorKind:
    """`kind` as measured by a sensor at m on the robot: with a ∘ m in place of the pose a."""
    instead = "a ∘ m and b ∘ m for a and b" if kind.connects[0] == kind.connects[1] else "a ∘ m for a"
    ends, residual = (*kind.connects, kind.connects[0]), f"that of {kind.name} with {instead}"
    return replace(kind, name=f"{kind.name}_mount", connects=ends, residual=residual, base=kind.name)


FACTOR_KINDS = FactorKinds(
    (kind.name, kind)
    for kind in (
        FactorKind("prior_se2", ("se2",), 3, 3, _POSE2 + ", in the map", "z⁻¹ ∘ x as (x, y, wrap θ)", (1.0, 2.0, 0.5)),
        FactorKind(
            "prior_se3",
            ("se3",),
            7,
            6,
            _POSE3 + ", in the map",
            "z⁻¹ ∘ x as (x, y, z, qx, qy, qz), sign with qw ≥ 0",
            (1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8),
            half_angles=True,
        ),
        FactorKind("prior_point2", ("point2",), 2, 2, "x y (metres), in the map", "x − z", (3.0, 4.0)),
        FactorKind("prior_point3", ("point3",), 3, 3, "x y z (metres), in the map", "x − z", (3.0, 4.0, 5.0)),
        FactorKind(
            "between_se2",
            ("se2", "se2"),
            3,
            3,
            _POSE2 + ": the second pose in the first one's frame",
            "z⁻¹ ∘ (a⁻¹ ∘ b) as (x, y, wrap θ)",
            (1.0, 0.0, 0.25),
        ),
        FactorKind(
            "between_se3",
            ("se3", "se3"),
            7,
            6,
            _POSE3 + ": the second pose in the first one's frame",
            "z⁻¹ ∘ (a⁻¹ ∘ b) as (x, y, z, qx, qy, qz), qw ≥ 0",
            (1.0, 0.0, 0.5, 0.0, 0.0, 0.6, 0.8),
            half_angles=True,
        ),
        FactorKind(
            "landmark_se2",
            ("se2", "point2"),
            2,
            2,
            "x y (metres): the point in the pose's frame",
            "Rₐᵀ (l − tₐ) − z",
            (2.0, 1.0),
        ),
        FactorKind(
            "landmark_se3",
            ("se3", "point3"),
            3,
            3,
            "x y z (metres): the point in the pose's frame",
            "Rₐᵀ (l − tₐ) − z",
            (2.0, 1.0, 0.5),
        ),
        FactorKind(
            "bearing_range_se2",
            ("se2", "point2"),
            2,
            2,
            "bearing (radians), range (metres), from the pose",
            "u = Rₐᵀ (l − tₐ): (wrap(atan2(u_y, u_x) − z₀), ‖u‖ − z₁)",
            (0.25, 2.5),
        ),
        FactorKind(
            "idp_first",
            ("se3", "idp"),
            14,
            6,
            f"{_PIXEL}, rho (1/metre), {_LENS}",
            "((x, y, z) − tₐ, pixel(Rₐᵀ a) − (u, v), ρ − ρ₀) with a as below",
            (330.0, 250.0, 0.25, *_RADTAN),
        ),
        FactorKind(
            "idp_seen",
            ("se3", "idp"),
            13,
            2,
            f"{_PIXEL}, {_LENS}",
            "pixel(Rₐᵀ a) − (u, v), a = ((x, y, z) − tₐ) ρ + m, m = (cos φ sin θ, −sin φ, cos φ cos θ)",
            (330.0, 250.0, *_RADTAN),
        ),
        FactorKind(
            "point_seen",
            ("se3", "point3"),
            13,
            2,
            f"{_PIXEL}, {_LENS}",
            "pixel(Rₐᵀ (l − tₐ)) − (u, v)",
            (330.0, 250.0, *_RADTAN),
        ),
        FactorKind(
            "position_se2",
            ("se2",),
            4,
            2,
            "x y in the map, x y of the antenna on the robot (metres)",
            "t + R λ − (x y), λ on the robot",
            (4.0, 5.0, 0.5, 0.25),
        ),
        FactorKind(
            "position_se3",
            ("se3",),
            6,
            3,
            "x y z in the map, x y z of the antenna on the robot (metres)",
            "t + R λ − (x y z), λ on the robot",
            (4.0, 5.0, 6.0, 0.5, 0.25, 0.0),
        ),
        FactorKind("heading_se2", ("se2",), 1, 1, "theta in the map (radians)", "wrap(θ_x − θ)", (0.75,)),
        FactorKind(
            "attitude_se3",
            ("se3",),
            6,
            3,
            "a direction as the robot sees it, the same in the map (any length)",
            "Rᵀ g/‖g‖ − b/‖b‖, b as the robot sees it, g in the map",
            (0.0, 0.1, -1.0, 0.0, 0.0, -9.81),
        ),
        FactorKind("range_se2", ("se2", "point2"), 1, 1, "distance (metres)", "‖l − tₐ‖ − z", (2.5,)),
        FactorKind("range_se3", ("se3", "point3"), 1, 1, "distance (metres)", "‖l − tₐ‖ − z", (2.5,)),
        FactorKind("range_between_se2", ("se2", "se2"), 1, 1, "distance (metres)", "‖t_b − tₐ‖ − z", (2.5,)),
        FactorKind("range_between_se3", ("se3", "se3"), 1, 1, "distance (metres)", "‖t_b − tₐ‖ − z", (2.5,)),
        FactorKind(
            "bearing_se2",
            ("se2", "point2"),
            1,
            1,
            "bearing (radians), from the pose",
            "wrap(atan2(u_y, u_x) − z), u = Rₐᵀ (l − tₐ)",
            (-0.25,),
        ),
        FactorKind(
            "bearing_se3",
            ("se3", "point3"),
            3,
            3,
            "direction from the pose (any length)",
            "u/‖u‖ − z/‖z‖, u = Rₐᵀ (l − tₐ)",
            (2.0, 1.0, 0.5),
        ),
    )
)
# And those of a sensor whose mount is estimated: of all that one pose measures of another, or of a point.
FACTOR_KINDS.update((f"{name}_mount", _with_mount(FACTOR_KINDS[name])) for name in _WITH_MOUNT)


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
        ChangeKind("marginalize", "keys"),
    )
}
