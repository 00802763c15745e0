"""What is written first in a factor of one's own and has no meaning there: each says what is written instead."""

from __future__ import annotations

from typing import Any, NoReturn

from factorbus.proto.expressions.declaration import BadExpression
from factorbus.proto.expressions.operations import ABSENT, OPERATIONS, SE2, SE3, SO3, Type, name_of
from factorbus.proto.nearest import nearest

_WHERE = "of factorbus.client.expressions"
_COMPARED = "select(a - b, x, y), which is x where a ≥ b, else y"
_POWERS = "a * a, sqrt(a), or dot(a, a) for the square of a vector's length"
_PRODUCT = "dot(a, b) of vectors, a * b of poses or rotations, a.act(b) of a pose and a point"
_JOINED = "vector(a, b), which joins them"
_LARGER = "select(a - b, a, b), or select(a - b, b, a) for the smaller"

# Functions of NumPy, by their names, and what is written instead.
_NUMPY = {
    **dict.fromkeys(("norm", "absolute", "abs", "fabs"), "norm(a), which of a number is |a|"),
    **dict.fromkeys(("square", "power", "float_power"), _POWERS),
    **dict.fromkeys(("matmul", "dot", "inner", "vdot", "einsum", "tensordot"), _PRODUCT),
    **dict.fromkeys(("concatenate", "hstack", "stack", "vstack", "append", "array", "column_stack"), _JOINED),
    **dict.fromkeys(("maximum", "minimum", "clip", "fmax", "fmin"), _LARGER),
    **dict.fromkeys(
        ("where", "greater", "greater_equal", "less", "less_equal", "equal", "not_equal", "sign"), _COMPARED
    ),
    **{name: f"{name}(a)" for name in ("sin", "cos", "sqrt")},
    "tan": "sin(a) / cos(a)",
    "arctan2": "atan2(a, b)",
    "arctan": "atan2(a, 1)",
    "hypot": "norm(vector(a, b))",
    "cross": "cross(a, b)",
    **dict.fromkeys(("exp", "log", "log10", "log2", "log1p", "expm1"), f"no such function of a number. {ABSENT}"),
}

# What others call an attribute, and what it is called here; of a pose in space where there are two.
_X, _Y = (f".position[{k}] of a pose, [{k}] of a vector" for k in (0, 1))
_ATTRIBUTES = {
    **dict.fromkeys(
        ("theta", "yaw", "angle", "phi"), ".heading of a pose in the plane, log(a.rotation) of one in space"
    ),
    **dict.fromkeys(("t", "translation", "trans", "p", "xy", "xyz", "pos"), ".position"),
    **dict.fromkeys(("R", "q", "rot", "orientation", "attitude", "quaternion"), ".rotation of a pose in space"),
    **dict.fromkeys(("inv", "T", "transpose", "inverted"), ".inverse()"),
    **dict.fromkeys(("transform", "apply", "transform_from", "transformFrom"), ".act(point)"),
    **dict.fromkeys(("transform_to", "transformTo"), ".inverse().act(point)"),
    **dict.fromkeys(("range", "distance"), "norm(a.inverse().act(point))"),
    **dict.fromkeys(("shape", "size"), "len(a)"),
    "x": _X,
    "y": _Y,
    "z": ".position[2] of a pose, [2] of a vector",
}
_POSE = (".position", ".inverse()", ".compose(b)", ".between(b)", ".act(point)", ".rotate(direction)", "log(a)")
_HAS: dict[Type, tuple[str, ...]] = {
    SE2: (*_POSE, ".heading"),
    SE3: (*_POSE, ".rotation"),
    SO3: (".inverse()", ".compose(b)", ".between(b)", ".rotate(direction)", "log(a)", "vector_part(a)"),
}


class NoAttribute(BadExpression, AttributeError):
    """An expression has no such attribute.  An AttributeError as well, so that `hasattr` is False."""


class NotComputed:
    """What Python and NumPy try with an expression, which has no value while it is written.  Raises BadExpression."""

    __hash__ = object.__hash__

    def __bool__(self) -> bool:
        raise _refused("if, and, or, not, while", _COMPARED)

    def __eq__(self, _other: object) -> bool:
        raise _refused("==", _COMPARED)

    def __ne__(self, _other: object) -> bool:
        raise _refused("!=", _COMPARED)

    def __lt__(self, _other: object) -> NoReturn:
        raise _refused("<", _COMPARED)

    def __le__(self, _other: object) -> NoReturn:
        raise _refused("<=", _COMPARED)

    def __gt__(self, _other: object) -> NoReturn:
        raise _refused(">", _COMPARED)

    def __ge__(self, _other: object) -> NoReturn:
        raise _refused(">=", _COMPARED)

    def __pow__(self, _other: object) -> NoReturn:
        raise _refused("**", _POWERS)

    def __rpow__(self, _other: object) -> NoReturn:
        raise _refused("**", f"no power of a number. {ABSENT}")

    def __abs__(self) -> NoReturn:
        raise _refused("abs", _NUMPY["abs"])

    def __matmul__(self, _other: object) -> NoReturn:
        raise _refused("@", _PRODUCT)

    def __rmatmul__(self, _other: object) -> NoReturn:
        raise _refused("@", _PRODUCT)

    def __mod__(self, _other: object) -> NoReturn:
        raise _refused("%", "wrap(a), which brings an angle into [−π, π)")

    def __floordiv__(self, _other: object) -> NoReturn:
        raise _refused("//", "a / b")

    def __round__(self, _digits: int = 0) -> NoReturn:
        raise _refused("round", "it without: a residual has slopes")

    def __float__(self) -> float:
        raise _refused("float, or a function of math", f"sin, cos, sqrt, atan2, norm {_WHERE}")

    def __int__(self) -> int:
        raise _refused("int", "it without: a residual has slopes")

    def __index__(self) -> int:
        raise _refused("as an index or a count", "a fixed number: a formula has all its steps when it is written")

    def __call__(self, *_of: object, **_named: object) -> NoReturn:
        raise _refused("()", ".position, .rotation and .heading without parentheses")

    def __setitem__(self, _index: object, _value: object) -> NoReturn:
        raise _refused("a[0] = b", "vector(b, a[1:]), which is another expression")

    def __array__(self, *_of: object, **_named: object) -> NoReturn:
        raise _refused("as an array of NumPy", f"norm, dot, cross, vector {_WHERE}")

    def __array_function__(self, function: Any, _types: object, _given: object, _named: object) -> NoReturn:
        raise no_numpy(function.__name__)


def no_numpy(name: str) -> BadExpression:
    """A function of NumPy has been given an expression."""
    found = _NUMPY.get(name, f"one {_WHERE}: {', '.join(OPERATIONS)}{nearest(name, OPERATIONS)}")
    return _refused(f"np.{name}", found)


def no_attribute(kind: Type, name: str) -> NoAttribute:
    """An expression of that type has no such attribute."""
    has = _HAS.get(kind, ("[0]", "[0:2]", f"the functions {_WHERE}"))
    if name in OPERATIONS:
        wanted = f"{name}(a), a function {_WHERE}"
    else:
        wanted = _ATTRIBUTES.get(name) or ", ".join(has) + nearest(f".{name}", has)
    return NoAttribute(f"an expression of {name_of(kind)} has no .{name}; wanted {wanted}")


def _refused(written: str, wanted: str) -> BadExpression:
    return BadExpression(f"{written}: an expression has no value while it is written; wanted {wanted}")
