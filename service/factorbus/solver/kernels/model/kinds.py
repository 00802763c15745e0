"""The kinds of factors: the residual of each, and what kernels have to know of it.  MATH §3.

Names, ends and sizes are the wire's, `factorbus.proto.kinds`.  Here each kind has its residual function, called as
residual(x, i, j, p, k, r, A, B): see `se2`.  One of several kinds is called as residual(kind, x, ends, p, k, r, A, B),
with `records.Ends` in place of i and j.  From these declarations follow `residual_of`, which calls the function of
a kind, and the predicates.  The order of codes means nothing.  A kind that is in one list and not in the other is an
error when this file is imported.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorbus.proto.derived_kinds import LENSES
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part, shared_kernel, types
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import observation
from factorbus.solver.kernels.model.dispatch import check_same, dispatcher
from factorbus.solver.kernels.model.points import prior_point2, prior_point3
from factorbus.solver.kernels.model.pose_measurements import attitude_se3, heading_se2, position_se2, position_se3
from factorbus.solver.kernels.model.range_bearing import (
    bearing_se2,
    bearing_se3,
    range_between_se2,
    range_between_se3,
    range_se2,
    range_se3,
)
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.kernels.model.se2 import bearing_range_se2, between_se2, landmark_se2, prior_se2
from factorbus.solver.kernels.model.se3 import between_se3, landmark_se3, prior_se3
from factorbus.solver.kernels.model.similarity import similar
from factorbus.solver.kernels.model.sizes import MOST_ENDS
from factorbus.solver.kernels.model.velocity import length_vector3, velocity_frame_se2, velocity_frame_se3
from factorbus.solver.lenses.layout import GOOD

_MOST = 6  # numbers of a residual and of a tangent: the size of the scratch that kernels have for a factor
_MOST_UNITS = 2


@dataclass(frozen=True, slots=True)
class FactorModel:
    """What the solver has for a kind of factor, beside what the wire says.

    residual:     r, A = ∂r/∂xᵢ, B = ∂r/∂xⱼ of one factor.  equation: where MATH has it
    of_kinds:     the function is that of several kinds, and takes the code of the kind first
    common:       it melts into `residual_of`; others are called from there
    initializes:  an end without a value gets one from it (`graph.initialize`)
    rigid:        r is the same where both ends move as one body, and that is made use of (`bayes_tree.rigid_subtrees`)
    bounded:      its linearization error has a closed form, (9.4) to (9.13); of others it is computed, (9.11)
    lens_at:      where in the measurement the lens is; −1: no camera saw it.  The function of what a camera sees
                  returns what χ² has beside rᵀ Ω r
    positive_at:  where in the measurement a number has to be above zero
    quaternions:  where in the measurement quaternions begin.  directions: and directions.  Both become unit
    joined:       `many` evaluates it (`similarity`), whatever the sizes of its variables
    base:         the kind that it is with further variables (`composed`), whose residual it has
    """

    residual: Callable[..., Any]
    equation: str
    of_kinds: bool = False
    common: bool = False
    initializes: bool = False
    rigid: bool = False
    bounded: bool = False
    lens_at: int = -1
    positive_at: int = -1
    quaternions: tuple[int, ...] = ()
    directions: tuple[int, ...] = ()
    joined: bool = False
    base: str = ""


def _usual(residual: Callable[..., Any], equation: str, rigid: bool = False, **more: Any) -> FactorModel:
    """A kind that places new variables, and that most graphs are of."""
    return FactorModel(residual, equation, common=True, initializes=True, bounded=True, rigid=rigid, **more)


def _seen(equation: str, lens_at: int, **more: Any) -> FactorModel:
    """What a camera sees."""
    return FactorModel(observation, equation, of_kinds=True, common=True, lens_at=lens_at, **more)


def _similar(equation: str, **more: Any) -> FactorModel:
    """Of rotations and similarities."""
    return FactorModel(similar, equation, joined=True, **more)


# Kinds are looked for in this order.
FACTOR_MODELS = {
    "between_se2": _usual(between_se2, "MATH (3.2)", rigid=True),
    "landmark_se2": _usual(landmark_se2, "MATH (3.3)", rigid=True),
    "bearing_range_se2": _usual(bearing_range_se2, "MATH (3.4)", rigid=True, positive_at=1),
    "prior_se2": _usual(prior_se2, "MATH (3.1)"),
    "between_se3": _usual(between_se3, "MATH (3.6)", rigid=True, quaternions=(3,)),
    "landmark_se3": _usual(landmark_se3, "MATH (3.7)", rigid=True),
    "prior_se3": _usual(prior_se3, "MATH (3.5)", quaternions=(3,)),
    "prior_point2": _usual(prior_point2, "MATH (3.8)"),
    "prior_point3": _usual(prior_point3, "MATH (3.8)"),
    "idp_first": _seen("MATH (3.15)", 3, initializes=True),
    "idp_seen": _seen("MATH (3.16)", 2),
    "point_seen": _seen("MATH (3.17)", 2, rigid=True),
    "position_se2": FactorModel(position_se2, "MATH (3.20)"),
    "position_se3": FactorModel(position_se3, "MATH (3.20)"),
    "heading_se2": FactorModel(heading_se2, "MATH (3.21)"),
    "attitude_se3": FactorModel(attitude_se3, "MATH (3.22)", directions=(0, 3)),
    "range_se2": FactorModel(range_se2, "MATH (3.23)", rigid=True, positive_at=0),
    "range_se3": FactorModel(range_se3, "MATH (3.23)", rigid=True, positive_at=0),
    "range_between_se2": FactorModel(range_between_se2, "MATH (3.34)", rigid=True, positive_at=0),
    "range_between_se3": FactorModel(range_between_se3, "MATH (3.34)", rigid=True, positive_at=0),
    "velocity_frame_se2": FactorModel(velocity_frame_se2, "MATH (3.42)"),
    "velocity_frame_se3": FactorModel(velocity_frame_se3, "MATH (3.42)"),
    "length_vector3": FactorModel(length_vector3, "MATH (3.62)", positive_at=0),
    "bearing_se2": FactorModel(bearing_se2, "MATH (3.24)", rigid=True),
    "bearing_se3": FactorModel(bearing_se3, "MATH (3.25)", rigid=True, directions=(0,)),
    "prior_so3": _similar("MATH (3.55)", initializes=True, quaternions=(0,)),
    "between_so3": _similar("MATH (3.55)", initializes=True, quaternions=(0,)),
    "attitude_so3": _similar("MATH (3.22)", directions=(0, 3)),
    "prior_sim3": _similar("MATH (3.56)", initializes=True, quaternions=(3,), positive_at=7),
    "between_sim3": _similar("MATH (3.57)", initializes=True, quaternions=(3,), positive_at=7),
    "landmark_sim3": _similar("MATH (3.58)", initializes=True),
    "position_sim3": _similar("MATH (3.59)"),
}
# By the last modifier of a kind with a base.
_EQUATIONS = {
    "mount": "MATH (3.35)",
    "bias": "MATH (3.36)",
    "scale": "MATH (3.37)",
    "frame": "MATH (3.38)",
    "arm": "MATH (3.41)",
    "offset": "MATH (3.40)",
    "focal": "MATH (3.54)",
    "bundler": "MATH (3.54)",
    "intrinsics": "MATH (3.54)",
}
FACTOR_MODELS |= {
    name: replace(
        FACTOR_MODELS[kind.base],
        equation=_EQUATIONS[kind.modifiers[-1]],
        common=False,
        rigid=False,
        bounded=False,
        base=kind.base,
    )
    for name, kind in FACTOR_KINDS.items()
    if kind.base
}


def check_kinds() -> None:
    """Every kind of the wire has a model that fits it.  Raises ImportError."""
    check_same("factor kind", FACTOR_KINDS, FACTOR_MODELS, __name__)
    for name, model in FACTOR_MODELS.items():
        kind = FACTOR_KINDS[name]
        ends = [VARIABLE_KINDS[end] for end in kind.connects]
        most = MOST_ENDS if model.base else 2
        own = ends[: len(FACTOR_KINDS[kind.base or name].connects)]  # the others are in a Jacobian of any width
        if not 1 <= len(ends) <= most or (not model.joined and max(kind.dim, *(end.dim for end in own)) > _MOST):
            raise ImportError(
                f"the factor kind {name!r} has {len(ends)} ends and a residual of the size {kind.dim}; "
                f"kernels have room for 1 to {most} variables and {_MOST} numbers"
            )
        starts = (*model.quaternions, *model.directions, model.positive_at)
        units = max(len(model.quaternions), len(model.directions))
        if max(starts) >= kind.size or units > _MOST_UNITS:
            raise ImportError(
                f"the factor kind {name!r} has a measurement of the size {kind.size} and checks at {starts}; "
                f"declare positions in the measurement, at most {_MOST_UNITS} quaternions and directions"
            )


check_kinds()
# The last are in place of a kind's for linear factors, for members of a factor of more than two variables, which are
# not looked at alone, for clients' own kinds, and for inertial ones, with samples and integrated already.  `many`
# evaluates all of these but members.
_MODELS = (
    *(FACTOR_MODELS[name] for name in FACTOR_KINDS),
    FactorModel(prior_point2, "MATH (3.26)"),
    FactorModel(prior_point2, "", bounded=True),
    FactorModel(prior_point2, "MATH §3.11"),
    FactorModel(prior_point2, "MATH (3.48)"),
    FactorModel(prior_point2, "MATH (3.60)"),
)


def _table(values: Any) -> I64:
    """By the code of a kind."""
    return np.array([int(value) for value in values], np.int64)


def _starts(lists: Any) -> I64:
    """The same of up to _MOST_UNITS positions a kind; −1: no more."""
    return np.array([(*starts, *[-1] * (_MOST_UNITS - len(starts))) for starts in lists], np.int64)


_INITIALIZES = np.array([model.initializes for model in _MODELS])
_RIGID = np.array([model.rigid for model in _MODELS])
_LENS_AT = _table(model.lens_at for model in _MODELS)
_POSITIVE_AT = _table(model.positive_at for model in _MODELS)
_QUATERNIONS = _starts(model.quaternions for model in _MODELS)
_DIRECTIONS = _starts(model.directions for model in _MODELS)
# For Python, which asks for many factors at once: by the code of a kind.
CAMERA = _LENS_AT >= 0
BOUNDED = np.array([model.bounded for model in _MODELS])
# Whether it is a family of kinds, whose variables and sizes are each factor's own: linear, own, inertial.
OF_FAMILY = np.isin(np.arange(len(_MODELS)), (at.LINEAR, at.OWN, at.IMU, at.PREINTEGRATED))
# By the code of a kind of variables.
POSE = np.array([kind.is_pose for kind in VARIABLE_KINDS.values()])
VECTOR = np.array([kind.is_vector for kind in VARIABLE_KINDS.values()])
SEES_LANDMARK = np.array([*(kind.sees_landmark for kind in FACTOR_KINDS.values()), *[False] * at.FURTHER_CODES])
_BASE = _table(at.FACTOR_CODES[model.base] if model.base else -1 for model in _MODELS)
# Which variable of a kind is a pose, but no place in the map: a mount or another frame; −1: none.
ASIDE_END = _table(
    [
        *(
            min([n for n, role in enumerate(kind.roles) if role in ("mount", "frame")], default=-1)
            for kind in FACTOR_KINDS.values()
        ),
        *[-1] * at.FURTHER_CODES,
    ]
)
# Whether it joins two places in the map, which its first two variables are; linear factors are asked apart.
JOINS_PLACES = np.array(
    [
        *(
            len(FACTOR_KINDS[kind.base or name].connects) == 2 and not any(kind.roles[:2])
            for name, kind in FACTOR_KINDS.items()
        ),
        *(code != at.MEMBER for code in range(at.LINEAR, len(_MODELS))),
    ]
)
# Whether it says where its first variable is in the map, alone or with other variables that are no places.
ABSOLUTE = np.array([*(kind.is_absolute for kind in FACTOR_KINDS.values()), *[False] * at.FURTHER_CODES])
MODIFIERS = ("mount", "bias", "scale", "frame", "arm", "offset", *LENSES)
MOUNT, BIAS, SCALE, FRAME, ARM, OFFSET, FOCAL, BUNDLER, INTRINSICS = range(9)
_JOINED = np.array([model.joined or model.base != "" for model in _MODELS])
# By the code of a kind: whether numbers of its lens are a variable.
LENS_IS_VARIABLE = np.array(
    [*(any(of in LENSES for of in kind.modifiers) for kind in FACTOR_KINDS.values()), *[False] * at.FURTHER_CODES]
)
# Which variable of a kind is that of a modifier; −1: it has none.
_MODIFIER_ENDS = np.full((len(_MODELS), len(MODIFIERS)), -1, np.int64)
for _row, _kind in enumerate(FACTOR_KINDS.values()):
    for _n, _modifier in enumerate(_kind.modifiers):
        _MODIFIER_ENDS[_row, MODIFIERS.index(_modifier)] = len(FACTOR_KINDS[_kind.base].connects) + _n


@inline_kernel
def base_kind(kind: int) -> int:
    """The kind that it is with further variables; −1: of none."""
    return _BASE[kind]


@inline_kernel
def end_of_modifier(kind: int, modifier: int) -> int:
    """Which of the variables of a kind is that of a modifier, such as MOUNT; −1: it has none."""
    return _MODIFIER_ENDS[kind, modifier]


@inline_kernel
def joins_places(kind: int) -> bool:
    """Whether it joins two places in the map, or is of a family, whose variables may be anything."""
    return JOINS_PLACES[kind]


@inline_kernel
def is_joined(kind: int) -> bool:
    """Whether `many` evaluates a kind of fixed sizes: it has a base, or is of rotations or similarities."""
    return _JOINED[kind]


@inline_kernel
def lens_is_variable(kind: int) -> bool:
    """Whether numbers of the lens are a variable, and those in the measurement stand for nothing."""
    return LENS_IS_VARIABLE[kind]


@inline_kernel
def is_camera(kind: int) -> bool:
    """Whether a kind of factor is what a camera sees."""
    return _LENS_AT[kind] >= 0


@inline_kernel
def lens_at(kind: int) -> int:
    """Where in the measurement its lens is; −1: no camera saw it."""
    return _LENS_AT[kind]


@inline_kernel
def initializes(kind: int) -> bool:
    """Whether it gives a value to an end that has none."""
    return _INITIALIZES[kind]


@inline_kernel
def is_rigid(kind: int) -> bool:
    """Whether its residual stays as its ends move as one body."""
    return _RIGID[kind]


@inline_kernel
def is_bounded(kind: int) -> bool:
    """Whether a closed form bounds its linearization error."""
    return BOUNDED[kind]


@inline_kernel
def positive_at(kind: int) -> int:
    """Which number of its measurement has to be above zero; −1: none."""
    return _POSITIVE_AT[kind]


@inline_kernel
def quaternion_at(kind: int, n: int) -> int:
    """Where its n-th measured quaternion begins; −1: there is none."""
    return _QUATERNIONS[kind, n]


@inline_kernel
def direction_at(kind: int, n: int) -> int:
    """Where its n-th measured direction begins; −1: there is none."""
    return _DIRECTIONS[kind, n]


_alone = {name: model for name, model in FACTOR_MODELS.items() if not model.base and not model.joined}
_common = {name: model for name, model in _alone.items() if model.common}
_others = {name: model for name, model in _alone.items() if not model.common}
_other_residual_of = inline_kernel(dispatcher("other_residual_of", _others))


@part
def _other_residual(kind: int, x: F64, ends: Ends, p: F64, k: int, r: F64, A: F64, B: F64) -> float:
    """Of the kinds that are not common."""
    r[at.R_STATUS] = GOOD
    return _other_residual_of(kind, x, ends, p, k, r, A, B)


_residual_of = inline_kernel(dispatcher("residual_of", _common, _other_residual))
_FLOATS, _ROWS = types.float64[::1], types.float64[:, ::1]
_ENDS = types.NamedUniTuple(types.int64, 2, Ends)


@shared_kernel(types.float64(types.int64, _FLOATS, _ENDS, _FLOATS, types.int64, _FLOATS, _ROWS, _ROWS))
def residual_of(kind: int, x: F64, ends: Ends, p: F64, k: int, r: F64, A: F64, B: F64) -> float:
    """The residual function of a kind; gives what χ² has beside rᵀ Ω r."""
    return _residual_of(kind, x, ends, p, k, r, A, B)
