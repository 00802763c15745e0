"""What an expression may do: each operation with the types it takes and the type that it gives.

A type is a rotation ("so3"), a pose ("se2", "se3") or a vector of n numbers, written as the number n; a scalar is a
vector of one.  Values are as those of variables: an so3 is a unit quaternion (x, y, z, w).

Every operation is declared by its forms, such as "se2, 2 → 2": what is checked and what people read is made of these.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from factorbus.wording import counted

Type: TypeAlias = str | int

SO3, SE2, SE3 = "so3", "se2", "se3"
GROUPS = {SO3: (4, 3), SE2: (3, 3), SE3: (7, 6)}  # numbers, and numbers of a tangent
MOST_NUMBERS = 64  # of a vector


class Mismatch(ValueError):
    """An operation does not take what it was given."""


def value_size(kind: Type) -> int:
    """How many numbers a value has."""
    return kind if isinstance(kind, int) else GROUPS[kind][0]


def tangent_size(kind: Type) -> int:
    """How many numbers a change of it has."""
    return kind if isinstance(kind, int) else GROUPS[kind][1]


def name_of(kind: Type) -> str:
    """For people."""
    return ("a number" if kind == 1 else f"a vector of {kind}") if isinstance(kind, int) else kind


def zero_of(kind: Type) -> tuple[float, ...]:
    """The identity; of a vector zeros."""
    size = value_size(kind)
    return (0.0,) * size if kind in (SE2, *range(1, MOST_NUMBERS + 1)) else (*(0.0,) * (size - 1), 1.0)


@dataclass(frozen=True, slots=True)
class Operation:
    """One operation.

    means: for people, with a, b and c, its arguments.  forms: the types that it takes and gives, one or more "A, B → C"
    with ";" between: n is any number of numbers, the same throughout a form, G one of GROUPS.  wants: what arguments it
    takes, for people.  numbers: how many constant integers come after them.
    """

    name: str
    means: str
    forms: str
    wants: str
    numbers: int = 0

    @property
    def arguments(self) -> int:
        """How many expressions it takes, −1: any number."""
        takes = _forms(self.forms)[0][0]
        return -1 if _MORE in takes else len(takes)

    def gives(self, given: Sequence[Type], numbers: Sequence[int]) -> Type:
        """The type of the result, of those of the arguments and the constant integers.  Raises Mismatch."""
        if self.arguments < 0:
            return self._joined(given)
        for takes, result in _forms(self.forms):
            bound: dict[str, Type] = {}
            if all(_fits(wanted, kind, bound) for wanted, kind in zip(takes, given, strict=True)):
                return self._taken(given[0], numbers) if self.numbers else bound.get(result, _type(result))
        raise self._mismatch(given, self.wants)

    def signature(self) -> str:
        """How it is written, with the names of its arguments."""
        if self.arguments < 0:
            return f"{self.name}(a,b,...)"
        return f"{self.name}({','.join([*'abc'[: self.arguments], *(_COUNTS if self.numbers else ())])})"

    def _taken(self, kind: Type, numbers: Sequence[int]) -> Type:
        first, count = numbers
        if first < 0 or count < 1:
            raise Mismatch(f"first is {first} and count is {count}, wanted first from 0 on and count from 1 on")
        if not isinstance(kind, int) or first + count > kind:
            raise self._mismatch([kind], f"a vector of at least {counted(first + count, 'number')}")
        return count

    def _joined(self, given: Sequence[Type]) -> Type:
        sizes = [kind for kind in given if isinstance(kind, int)]
        if not given or len(sizes) < len(given):
            raise self._mismatch(given, self.wants)
        if sum(sizes) > MOST_NUMBERS:
            raise self._mismatch(given, f"at most {MOST_NUMBERS} numbers together")
        return sum(sizes)

    def _mismatch(self, given: Sequence[Type], wanted: str) -> Mismatch:
        return Mismatch(f"got {' and '.join(map(name_of, given)) or 'nothing'}, wanted {wanted}")


_ANY, _GROUP, _MORE, _COUNTS = "n", "G", "…", ("first", "count")


@lru_cache(maxsize=64)
def _forms(text: str) -> tuple[tuple[tuple[str, ...], str], ...]:
    """What each form takes, and what it gives."""
    sides = [form.split(" → ") for form in text.split("; ")]
    return tuple((tuple(takes.split(", ")), result) for takes, result in sides)


def _type(word: str) -> Type:
    return int(word) if word.isdecimal() else word


def _fits(wanted: str, kind: Type, bound: dict[str, Type]) -> bool:
    """Whether a type is what a form wants there; bound: what n and G are, from the first that they stand for."""
    if wanted == _ANY:
        return isinstance(kind, int) and bound.setdefault(_ANY, kind) == kind
    if wanted == _GROUP:
        return kind in GROUPS and bound.setdefault(_GROUP, kind) == kind
    return kind == _type(wanted)


_ALIKE = "vectors of one size"
_POSE = "a pose"
_ANGLE = "a number"
_SPACED = "a pose or rotation, and a vector of its space"
_SPACES = "se2, 2 → 2; se3, 3 → 3; so3, 3 → 3"

OPERATIONS = {
    operation.name: operation
    for operation in (
        Operation("compose", "a ∘ b", "G, G → G", "rotations or poses of one kind"),
        Operation("inverse", "a⁻¹", "G → G", "a rotation or a pose"),
        Operation("act", "the point b of a's frame, in the frame that a is seen from", _SPACES, _SPACED),
        Operation("rotate", "the direction b of a's frame, in the frame that a is seen from", _SPACES, _SPACED),
        Operation("position", "where the pose a is", "se2 → 2; se3 → 3", _POSE),
        Operation("rotation", "how the pose a is turned", "se3 → so3", "a pose in space"),
        Operation("heading", "θ of the pose a", "se2 → 1", "a pose in the plane"),
        Operation(
            "pose",
            "the pose at a, turned by b",
            "2, 1 → se2; 3, so3 → se3",
            "2 numbers and a heading, or 3 and a rotation",
        ),
        Operation(
            "log",
            "the rotation vector of a; of a pose its position, and behind it that, in the plane θ",
            "so3 → 3; se2 → 3; se3 → 6",
            "a rotation or a pose",
        ),
        Operation("exp", "the rotation by the rotation vector a", "3 → so3", "3 numbers"),
        Operation("vector_part", "(x, y, z) of the quaternion a or −a, with w ≥ 0", "so3 → 3", "a rotation"),
        Operation("norm", "‖a‖", "n → 1", _ALIKE),
        Operation("dot", "aᵀ b", "n, n → 1", _ALIKE),
        Operation("cross", "a × b", "3, 3 → 3; 2, 2 → 1", "two vectors of 3, or of 2"),
        Operation("atan2", "the angle of (b, a), radians", "1, 1 → 1", "two numbers"),
        Operation("sqrt", "√a", "1 → 1", _ANGLE),
        Operation("sin", "sin a", "1 → 1", _ANGLE),
        Operation("cos", "cos a", "1 → 1", _ANGLE),
        Operation("wrap", "a, an angle, in [−π, π)", "1 → 1", _ANGLE),
        Operation("select", "b where a ≥ 0, else c", "1, n, n → n", "a number, and two vectors of one size"),
        Operation("add", "a + b", "n, n → n", _ALIKE),
        Operation("subtract", "a − b", "n, n → n", _ALIKE),
        Operation("negate", "−a", "n → n", _ALIKE),
        Operation(
            "multiply",
            "a b, number by number, or by the one number of one of them",
            "n, n → n; 1, n → n; n, 1 → n",
            "vectors of one size, or one of them a number",
        ),
        Operation("divide", "a / b", "n, 1 → n", "a vector and a number"),
        Operation(
            "part", "count numbers of a, from the number first on, which is 0 or more", "n → count", "a vector", 2
        ),
        Operation("vector", "the numbers of all, one after the other, 64 at most", "n, m, … → n + m + …", "vectors"),
    )
}

# What is to be known of the table, for people.
LEGEND = (
    "n and m are any number of numbers, the same throughout a form; G is so3, se2 or se3; first and count are integers."
)
# What people look for in vain, and what does instead.
ABSENT = (
    "There is no power, logarithm or exponential of numbers, no abs, tan, min or max. Write a² of a number as "
    "multiply(a,a), ‖a‖² as dot(a,a), |a| of a number as norm(a), tan a as divide(sin(a),cos(a)), the larger of two "
    "as select(subtract(a,b),a,b). Send as z the logarithm of what was read; that of a variable is made of roots and a "
    "series."
)
