"""The kinds of factors as the wire knows them: names, sizes and what connects to what.

The mathematics of each kind (residual, Jacobians, ⊞) is the solver's; this table is all a client needs to
build and read messages, and a test holds the two against each other.  A name never changes its meaning.
"""

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from factorbus.proto import inertial
from factorbus.proto.derived_kinds import derived_kinds
from factorbus.proto.expressions.declaration import BadExpression, Declaration
from factorbus.proto.expressions.formula import MOST_CHARACTERS, read_formula, write_formula
from factorbus.proto.expressions.operations import name_of, value_size, zero_of
from factorbus.proto.factor_kind import LINEAR, FactorKind
from factorbus.proto.similarity_kinds import SIMILARITY_KINDS
from factorbus.proto.variable_kinds import POSE2, POSE3, VARIABLE_KINDS
from factorbus.wording import counted

_PIXEL = "u v (pixels)"
_RADTAN = (1.0, 400.0, 401.0, 320.0, 240.0, 0.0, -0.25, 0.125, 0.001, -0.002, 0.0)
_LENS = "lens (11 numbers: `factorbus.proto.camera.Camera.lens`)"

# What a factor that is far off may count instead of r'Wr, by the name of the loss; its scale is in standard deviations.
LOSSES = ("huber", "cauchy", "geman-mcclure", "tukey", "dcs")

# The most variables of a linear factor; it has as many rows as they have scalars, and one more, at most.
MOST_JOINED = 128
LINEAR_NAME = "linear_ROWS_KIND_KIND..."
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


def imu_kind(samples: int) -> FactorKind:
    """The kind of inertial factors with that many samples.  Raises ValueError: none, or too many."""
    if not samples:
        raise ValueError(f"0 samples; wanted 1 to {inertial.MOST_SAMPLES}")
    return inertial_kind(inertial.ImuForm(samples))


@lru_cache(maxsize=1024)
def inertial_kind(form: inertial.ImuForm) -> FactorKind:
    """The kind of inertial factors of a form."""
    texts = form.measured, form.residual
    return FactorKind(form.name, form.ends, form.size, inertial.RESIDUAL, *texts, form.example, roles=form.roles)


def _imu_of_name(name: str) -> FactorKind | None:
    """The inertial kind of that name; None: there is none."""
    try:
        return inertial_kind(inertial.form_of_name(name))
    except ValueError:
        return None


def _linear_of_name(name: str) -> FactorKind | None:
    """The linear kind of that name; None: there is none."""
    if not name.startswith(LINEAR) or len(name) > _LONGEST:
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


def own_kind(declared: Declaration) -> FactorKind:
    """The kind that a declaration is.  Raises BadExpression: its name is one of the others'."""
    if declared.name in FACTOR_KINDS or declared.name.startswith((LINEAR, inertial.PREFIX)):
        raise BadExpression(f"{declared.name} is a kind that there is already; wanted another name")
    ends, name = tuple(kind for _, kind in declared.variables), write_formula(declared)
    measured, size = name_of(declared.measured), value_size(declared.measured)
    return FactorKind(
        name, ends, size, declared.residual_size, measured, name, zero_of(declared.measured), own=declared
    )


@lru_cache(maxsize=256)
def _own_of_name(name: str) -> FactorKind | None:
    """The own kind that a formula is; None: it is none."""
    try:
        return own_kind(read_formula(name))
    except BadExpression:
        return None


def _found_by_name(name: str) -> FactorKind | None:
    """Of the families of kinds, of which there are more than can be listed."""
    if _is_formula(name):
        return _own_of_name(name) if len(name) <= MOST_CHARACTERS else None
    return _imu_of_name(name) if name.startswith(inertial.PREFIX) else _linear_of_name(name)


def _is_formula(name: str) -> bool:
    """Whether a kind is meant that a client has written itself: its name has at most 63 characters before "("."""
    return "(" in name[:64]


def name_of_kind(kind: str) -> str:
    """For people: of an own kind what stands before its variables, of any other its name."""
    return kind.partition("(")[0]


class FactorKinds(dict[str, FactorKind]):
    """The kinds by name.  Those of linear factors, one for any rows and variables, of inertial factors, one for any
    number of samples, and those of one's own, whose name is their formula, are found by name as well, and are not among
    the entries."""

    def __missing__(self, name: str) -> FactorKind:
        if (kind := _found_by_name(name)) is None:
            raise KeyError(name)
        return kind

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or (isinstance(name, str) and _found_by_name(name) is not None)

    def get(self, name: str, default: Any = None) -> Any:
        """The kind of that name, or `default`."""
        found = super().get(name)
        return found or _found_by_name(name) or default

    def names(self, unknown: str = "") -> tuple[str, ...]:
        """For a person: all names, and the form of those of families.

        Of an `unknown` one that begins as these do, what is wrong with it.
        """
        if _is_formula(unknown):
            try:
                own_kind(read_formula(unknown))
            except BadExpression as why:
                return (f"a formula ({why})",)
        if unknown.startswith(LINEAR) and len(unknown) > _LONGEST:
            return (f"{LINEAR_NAME}, of up to {MOST_JOINED} variables",)
        for prefix, form, read in (
            (LINEAR, LINEAR_NAME, _read_linear),
            (inertial.PREFIX, inertial.NAME, inertial.form_of_name),
        ):
            if unknown.startswith(prefix):
                try:
                    read(unknown)
                except ValueError as why:
                    return (f"{form} ({why})",)
        return (*self, LINEAR_NAME, inertial.NAME, "or a formula")


FACTOR_KINDS = FactorKinds(
    (kind.name, kind)
    for kind in (
        FactorKind("prior_se2", ("se2",), 3, 3, POSE2 + ", in the map", "z⁻¹ ∘ x as (x, y, wrap θ)", (1.0, 2.0, 0.5)),
        FactorKind(
            "prior_se3",
            ("se3",),
            7,
            6,
            POSE3 + ", in the map",
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
            POSE2 + ": the second pose in the first one's frame",
            "z⁻¹ ∘ (a⁻¹ ∘ b) as (x, y, wrap θ)",
            (1.0, 0.0, 0.25),
        ),
        FactorKind(
            "between_se3",
            ("se3", "se3"),
            7,
            6,
            POSE3 + ": the second pose in the first one's frame",
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
        FactorKind(
            "velocity_frame_se2",
            ("se2", "vector2"),
            2,
            2,
            "vx vy in the frame f (m/s), as Doppler shifts tell",
            "R_f v − z, v along the axes of the map",
            (1.5, -0.5),
            roles=("frame", "axes"),
        ),
        FactorKind(
            "velocity_frame_se3",
            ("se3", "vector3"),
            3,
            3,
            "vx vy vz in the frame f (m/s), as Doppler shifts tell",
            "R_f v − z, v along the axes of the map",
            (1.5, -0.5, 0.25),
            roles=("frame", "axes"),
        ),
        FactorKind(
            "length_vector3", ("vector3",), 1, 1, "length (m/s² of gravity)", "‖x‖ − z", (9.8125,), roles=("axes",)
        ),
        *SIMILARITY_KINDS,
    )
)
# And those that these become with further variables: a mount, a bias, a scale, another frame, a lever arm, a clock.
FACTOR_KINDS.update([(kind.name, kind) for kind in derived_kinds(FACTOR_KINDS)])


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
        ChangeKind("accept", "factors"),
        ChangeKind("reject", "factors"),
    )
}
