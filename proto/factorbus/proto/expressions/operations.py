"""What an expression may do: each operation with the types it takes and the type that it gives.

A type is a rotation ("so3"), a pose ("se2", "se3") or a vector of n numbers, written as the number n; a scalar is a
vector of one.  Values are as those of variables: an so3 is a unit quaternion (x, y, z, w).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    """One operation.  gives: the type of its result, of those of its arguments; raises Mismatch.

    arguments: how many expressions it takes, −1: any number.  numbers: how many constant integers come after them.
    means: for people, with a and b, its arguments.
    """

    name: str
    arguments: int
    means: str
    gives: Callable[[Sequence[Type], Sequence[int]], Type]
    numbers: int = 0


def _need(given: Sequence[Type], wanted: str, *, holds: bool) -> None:
    if not holds:
        raise Mismatch(f"got {' and '.join(map(name_of, given)) or 'nothing'}, wanted {wanted}")


def _is_vector(kind: Type) -> bool:
    return isinstance(kind, int)


def _same_group(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    _need(given, "rotations or poses of one kind", holds=given[0] in GROUPS and len(set(given)) == 1)
    return given[0]


def _moved(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    size = {SO3: 3, SE3: 3, SE2: 2}.get(given[0], 0) if isinstance(given[0], str) else 0
    _need(given, "a pose or rotation, and a vector of its space", holds=size > 0 and given[1] == size)
    return size


def _of(wanted: dict[tuple[Type, ...], Type], words: str) -> Callable[[Sequence[Type], Sequence[int]], Type]:
    """Where a table has all cases."""

    def gives(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
        _need(given, words, holds=tuple(given) in wanted)
        return wanted[tuple(given)]

    return gives


def _alike(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    _need(given, "vectors of one size", holds=_is_vector(given[0]) and len(set(given)) == 1)
    return given[0]


def _to_number(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    _alike(given, _numbers)
    return 1


def _scaled(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    vectors = all(map(_is_vector, given))
    _need(given, "vectors of one size, or one of them a number", holds=vectors and (1 in given or given[0] == given[1]))
    return given[1] if given[0] == 1 else given[0]


def _divided(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    _need(given, "a vector and a number", holds=_is_vector(given[0]) and given[1] == 1)
    return given[0]


def _selected(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    alike = _is_vector(given[1]) and given[1] == given[2]
    _need(given, "a number, and two vectors of one size", holds=given[0] == 1 and alike)
    return given[1]


def _taken(given: Sequence[Type], numbers: Sequence[int]) -> Type:
    first, count = numbers
    inside = isinstance(given[0], int) and first >= 0 and count >= 1 and first + count <= given[0]
    _need(given, f"a vector of at least {counted(first + count, 'number')}", holds=inside)
    return count


def _joined(given: Sequence[Type], _numbers: Sequence[int]) -> Type:
    _need(given, "vectors", holds=len(given) > 0 and all(map(_is_vector, given)))
    total = sum(kind for kind in given if isinstance(kind, int))
    _need(given, f"at most {MOST_NUMBERS} numbers", holds=total <= MOST_NUMBERS)
    return total


_LOG = _of({(SO3,): 3, (SE2,): 3, (SE3,): 6}, "a rotation or a pose")
_ANGLE = _of({(1,): 1}, "a number")

OPERATIONS = {
    operation.name: operation
    for operation in (
        Operation("compose", 2, "a ∘ b", _same_group),
        Operation("inverse", 1, "a⁻¹", _same_group),
        Operation("act", 2, "the point b of a's frame, in the frame that a is seen from", _moved),
        Operation("rotate", 2, "the direction b of a's frame, in the frame that a is seen from", _moved),
        Operation("position", 1, "where the pose a is", _of({(SE2,): 2, (SE3,): 3}, "a pose")),
        Operation("rotation", 1, "how the pose a is turned", _of({(SE3,): SO3}, "a pose in space")),
        Operation("heading", 1, "θ of the pose a", _of({(SE2,): 1}, "a pose in the plane")),
        Operation(
            "pose",
            2,
            "the pose at a, turned by b",
            _of({(2, 1): SE2, (3, SO3): SE3}, "2 numbers and a heading, or 3 and a rotation"),
        ),
        Operation(
            "log", 1, "the rotation vector of a; of a pose its position, and behind it that, in the plane θ", _LOG
        ),
        Operation("exp", 1, "the rotation by the rotation vector a", _of({(3,): SO3}, "3 numbers")),
        Operation("vector_part", 1, "(x, y, z) of the quaternion a or −a, with w ≥ 0", _of({(SO3,): 3}, "a rotation")),
        Operation("norm", 1, "‖a‖", _to_number),
        Operation("dot", 2, "aᵀ b", _to_number),
        Operation("cross", 2, "a × b", _of({(3, 3): 3, (2, 2): 1}, "two vectors of 3, or of 2")),
        Operation("atan2", 2, "the angle of (b, a), radians", _of({(1, 1): 1}, "two numbers")),
        Operation("sqrt", 1, "√a", _ANGLE),
        Operation("sin", 1, "sin a", _ANGLE),
        Operation("cos", 1, "cos a", _ANGLE),
        Operation("wrap", 1, "a, an angle, in [−π, π)", _ANGLE),
        Operation("select", 3, "b where a ≥ 0, else c", _selected),
        Operation("add", 2, "a + b", _alike),
        Operation("subtract", 2, "a − b", _alike),
        Operation("negate", 1, "−a", _alike),
        Operation("multiply", 2, "a b, number by number, or by the one number of one of them", _scaled),
        Operation("divide", 2, "a / b", _divided),
        Operation("part", 1, "numbers of a: from which on, and how many", _taken, numbers=2),
        Operation("vector", -1, "the numbers of all, one after the other", _joined),
    )
}
