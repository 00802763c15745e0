"""Every way the solver refuses: one tree, one stable code each.  The code travels, the text is for a person.

    SolverError
    ├── UnknownMode            unknown_mode            a mode of solving that does not exist
    ├── BadOption              bad_option              a setting out of its range
    ├── TooLarge               too_large               more than is searched through in one piece
    ├── NoBackend              no_backend              a backend whose package is not installed
    ├── UnknownKind            unknown_kind            a kind of variable or factor that does not exist
    ├── KindTaken              kind_taken              an own kind with the name of another that the map has
    ├── BadShape               bad_shape               arrays whose sizes or types do not fit their kind or each other
    ├── DuplicateVariable      duplicate_variable      a key that is taken already
    ├── UnknownVariable        unknown_variable        a factor on a key that no variable has
    ├── KindMismatch           kind_mismatch           a factor on a variable of a kind it does not connect
    ├── SelfLoop               self_loop               a factor between a variable and itself
    ├── NotFinite              not_finite              a NaN or an infinity, given or arising
    ├── OutOfBounds            out_of_bounds           a number that double precision cannot compute with
    ├── Diverged               diverged                a step that leaves its bounds, or what is finite
    ├── BadQuaternion          bad_quaternion          a quaternion that is not of unit length
    ├── BadRange               bad_range               a range that is not positive
    ├── BadDirection           bad_direction           a direction that is no vector of some length
    ├── BadSamples             bad_samples             samples of an IMU without duration, or noise that cannot be
    ├── BadLens                bad_lens                a lens that cannot be
    ├── BadObservation         bad_observation         a pixel of what the camera cannot see
    ├── BadLoss                bad_loss                a loss that does not exist, or a scale that is not positive
    ├── NotPositiveDefinite    not_positive_definite   an information matrix that is not positive definite
    ├── UnknownFactor          unknown_factor          a factor id that the map does not have, or not any more
    ├── NotInMap               unknown_variable        a change of a variable that the map does not have
    ├── InUse                  in_use                  variables to be removed alone that other factors are on
    ├── TooConnected           too_connected           variables to be marginalized with too large a separator
    ├── BadOrder               bad_order               changes in an order that has no meaning
    ├── NamedTwice             named_twice             a change that names a factor or a variable twice
    ├── BadWeight              bad_weight              a weight out of its range
    ├── Uninitialized          uninitialized           a variable without value that no factor of its batch reaches
    └── Underconstrained       underconstrained        a variable that the factors leave free to move

`code`, `message` and `detail` (plain types) are what a service needs to pass any of them on.
"""

import math
from collections.abc import Sequence
from typing import Any

from factorbus.wording import counted, outside
from factorbus.wording.picklable import Picklable

_INDEX_BITS = 56


class SolverError(Picklable, Exception):
    """Base of everything the solver refuses.  Whatever was asked for has left no trace."""

    code = "solver_error"

    def __init__(self, message: str, **detail: Any) -> None:
        self.detail: dict[str, Any] = detail
        super().__init__(message)

    @property
    def message(self) -> str:
        """The text for a person."""
        return str(self.args[0])


def printed(key: int) -> str:
    """How a variable's key prints: x12 for ord("x") << 56 | 12, its number where no letter fits."""
    letter = key >> _INDEX_BITS
    if key >= 0 and chr(letter).isalpha():
        return f"{chr(letter)}{key & ((1 << _INDEX_BITS) - 1)}"
    return str(key)


class UnknownMode(SolverError):
    code = "unknown_mode"

    def __init__(self, seen: str, known: Sequence[str]) -> None:
        wanted = f"one of {', '.join(known)}"
        super().__init__(f"there is no mode {seen!r}; wanted {wanted}", seen=seen, wanted=wanted)


class BadOption(SolverError):
    code = "bad_option"

    def __init__(self, name: str, seen: str, wanted: str) -> None:
        super().__init__(f"option {name}: seen {seen}, wanted {wanted}", where=name, seen=seen, wanted=wanted)


class TooLarge(SolverError):
    code = "too_large"

    def __init__(self, what: str, size: int, limit: int, unit: str, mend: str = "ask for less at a time") -> None:
        super().__init__(f"{what} has {size} {unit}, the limit is {limit}; {mend}", size=size, limit=limit)


class NoBackend(SolverError):
    code = "no_backend"

    def __init__(self, backend: str, package: str, problem: str) -> None:
        super().__init__(
            f'backend "{backend}" needs {package}, which cannot be imported ({problem}): '
            f"pip install 'factorbus[{backend}]' (where pip compiles it, apt-get install libsuitesparse-dev first), "
            'or use backend "blocks"',
            backend=backend,
            package=package,
        )


_MOST_SHOWN = 200  # characters of a formula


def _cut(formula: str) -> str:
    return formula if len(formula) <= _MOST_SHOWN else f"{formula[:_MOST_SHOWN]}…"


class UnknownKind(SolverError):
    code = "unknown_kind"

    def __init__(self, what: str, seen: str, known: Sequence[str]) -> None:
        wanted = f"one of {', '.join(known)}"
        super().__init__(f"there is no kind of {what} {seen!r}; wanted {wanted}", seen=seen, wanted=wanted)


class KindTaken(SolverError):
    code = "kind_taken"

    def __init__(self, name: str, here: str, given: str) -> None:
        super().__init__(
            f"{name} is {_cut(here)} in this map, and is {_cut(given)} now; wanted another name for another kind",
            kind=name,
            here=here,
            given=given,
        )


class BadShape(SolverError):
    """The solver's own, as it knows no wire; it travels as the problem of that name and code."""

    code = "bad_shape"

    def __init__(self, where: str, seen: str, wanted: str) -> None:
        super().__init__(f"{where}: seen {seen}, wanted {wanted}", where=where, seen=seen, wanted=wanted)


class DuplicateVariable(SolverError):
    code = "duplicate_variable"

    def __init__(self, key: int, twice: bool = False) -> None:
        seen = "comes twice in one insert" if twice else "exists already"
        super().__init__(f"variable {printed(key)} {seen}; take another key, or leave it out if it is meant", key=key)


class UnknownVariable(SolverError):
    code = "unknown_variable"

    def __init__(self, key: int, factor: str) -> None:
        self.key, self.factor = key, factor
        super().__init__(
            f"{factor}: there is no variable {printed(key)}; add it in this batch or before", key=key, keys=[key]
        )


class KindMismatch(SolverError):
    code = "kind_mismatch"

    def __init__(self, key: int, factor: str, seen: str, wanted: str) -> None:
        super().__init__(
            f"{factor}: {printed(key)} is a {seen}, wanted a {wanted} there", key=key, seen=seen, wanted=wanted
        )


class SelfLoop(SolverError):
    code = "self_loop"

    def __init__(self, key: int, factor: str) -> None:
        super().__init__(f"{factor} joins {printed(key)} to itself; wanted two different variables", key=key)


class NotFinite(SolverError):
    code = "not_finite"

    def __init__(self, where: str) -> None:
        super().__init__(
            f"{where} holds or leads to a NaN or an infinity; wanted finite numbers",
            where=where,
            seen="a NaN or an infinity",
            wanted="finite numbers",
        )


class OutOfBounds(SolverError):
    code = "out_of_bounds"

    def __init__(self, where: str, seen: float, least: float, most: float, advice: str) -> None:
        wanted = f"at most {most:g} in magnitude" if least <= 0.0 else f"{least:g} to {most:g}"
        told = outside(seen, least, most)
        super().__init__(
            f"{where} is {told}, wanted {wanted}: beyond that its squares are lost to rounding, or overflow; {advice}",
            where=where,
            seen=told,
            wanted=wanted,
            least=least,
            most=most,
        )


class Diverged(SolverError):
    code = "diverged"

    def __init__(self, what: str, seen: str, most: float, **more: Any) -> None:
        bounds = f"{more['least']:g} to {most:g}" if "least" in more else f"at most {most:g} in magnitude"
        wanted = bounds if math.isfinite(most) else "a finite number"
        super().__init__(
            f"the step would leave {what} at {seen}, wanted {wanted}: what was inserted does not determine "
            "it, or contradicts the map; the map is as it was. Leave the factor out, or add a prior",
            where=what,
            seen=seen,
            wanted=wanted,
            most=most,
            **more,
        )


class BadQuaternion(SolverError):
    code = "bad_quaternion"

    def __init__(self, where: str, norm: str) -> None:
        super().__init__(
            f"{where}: the quaternion has length {norm}, wanted length 1 to within 1e-3, in the order qx qy qz qw",
            where=where,
            seen=norm,
            wanted="length 1 to within 1e-3",
        )


class BadRange(SolverError):
    code = "bad_range"

    def __init__(self, where: str, seen: float) -> None:
        super().__init__(
            f"{where}: the range is {seen:g}, wanted more than 0, metres",
            where=where,
            seen=f"{seen:g}",
            wanted="more than 0, metres",
        )


class BadDirection(SolverError):
    code = "bad_direction"

    def __init__(self, where: str) -> None:
        seen, wanted = "length 0", "a vector of any other length"
        super().__init__(f"{where}: a direction has {seen}, wanted {wanted}", where=where, seen=seen, wanted=wanted)


class BadSamples(SolverError):
    code = "bad_samples"

    def __init__(self, where: str, seen: str, wanted: str) -> None:
        super().__init__(f"{where}: {seen}; wanted {wanted}", where=where, seen=seen, wanted=wanted)


class BadLens(SolverError):
    code = "bad_lens"

    def __init__(self, where: str, seen: str, wanted: str) -> None:
        super().__init__(f"{where}: of its lens seen {seen}, wanted {wanted}", where=where, seen=seen, wanted=wanted)


class BadObservation(SolverError):
    code = "bad_observation"

    def __init__(self, where: str, pixel: tuple[float, float], reason: str) -> None:
        super().__init__(
            f"{where}: pixel ({pixel[0]:.6g}, {pixel[1]:.6g}): {reason}; leave this observation out",
            where=where,
            reason=reason,
        )


class BadLoss(SolverError):
    code = "bad_loss"

    def __init__(self, where: str, seen: str, wanted: str) -> None:
        super().__init__(f"{where}: seen {seen}, wanted {wanted}", where=where, seen=seen, wanted=wanted)


class NotPositiveDefinite(SolverError):
    code = "not_positive_definite"

    def __init__(self, where: str, smallest: float) -> None:
        super().__init__(
            f"{where}: the information matrix has the eigenvalue {smallest:.3g}, wanted all positive; it is the upper "
            "triangle, row by row, of the inverse of the measurement's covariance",
            where=where,
            seen=f"the eigenvalue {smallest:.3g}",
            wanted="all positive",
        )


class UnknownFactor(SolverError):
    code = "unknown_factor"

    def __init__(self, factor: int, following: int) -> None:
        gone = "it has been removed, or is one of the map's suspects, which the estimate does not have"
        never = f"the next one will be {following}" if following else "the map has had none so far"
        seen = gone if 0 <= factor < following else never
        super().__init__(
            f"there is no factor {factor}: {seen}; ids are in the answer to an insert, and in the graph of the map",
            factor=factor,
        )


class NotInMap(SolverError):
    code = "unknown_variable"

    def __init__(self, key: int, change: str) -> None:
        super().__init__(
            f"{change}: there is no variable {printed(key)}, or not any more; the map's estimate has those there are",
            key=key,
            keys=[key],
        )


class InUse(SolverError):
    code = "in_use"

    def __init__(self, key: int, factor: int, described: str, count: int) -> None:
        super().__init__(
            f"{printed(key)} is not to be removed alone: factor {factor}, {described}, is on it ({count} such in all); "
            "remove these as well, or say that everything on it goes",
            key=key,
            factor=factor,
            count=count,
        )


class TooConnected(SolverError):
    code = "too_connected"

    def __init__(self, key: int, count: int, separator: Sequence[int], most: int) -> None:
        listed = ", ".join(map(printed, separator[:8])) + (", ..." if len(separator) > 8 else "")
        super().__init__(
            f"{printed(key)} and what hangs together with it ({count} in all) cannot be marginalized: they share "
            f"factors with {counted(len(separator), 'other')}, {listed}; wanted at most {most}: marginalize some of "
            "these as well, or remove some of its factors first",
            key=key,
            separator=list(separator),
        )


class BadOrder(SolverError):
    code = "bad_order"

    def __init__(self, change: str, wanted: str) -> None:
        super().__init__(f"{change}: wanted it {wanted}; send it as an insert of its own", change=change)


class NamedTwice(SolverError):
    code = "named_twice"

    def __init__(self, change: str, named: str, **which: int) -> None:
        super().__init__(f"{change} names {named} twice; name it once", change=change, **which)


class BadWeight(SolverError):
    code = "bad_weight"

    def __init__(self, factor: int, seen: str, wanted: str) -> None:
        super().__init__(
            f"weight of factor {factor}: seen {seen}, wanted {wanted}; to count it for nothing, remove it",
            factor=factor,
            where=f"weight of factor {factor}",
            seen=seen,
            wanted=wanted,
        )


class Uninitialized(SolverError):
    code = "uninitialized"

    def __init__(self, key: int, factors: Sequence[str] = ()) -> None:
        listed = ", ".join(factors[:4]) + (", ..." if len(factors) > 4 else "")
        why = f"what is on it in its batch, {listed}, gives it none" if factors else "no factor of its batch is on it"
        super().__init__(
            f"variable {printed(key)} has no value and {why}; give it one, or a factor from a variable that has one",
            key=key,
        )


class Underconstrained(SolverError):
    code = "underconstrained"

    def __init__(self, key: int, factors: Sequence[str], missing: str) -> None:
        listed = ", ".join(factors[:8]) + (", ..." if len(factors) > 8 else "")
        by = f"is not fixed by its {counted(len(factors), 'factor')} ({listed}): {missing}"
        super().__init__(
            f"{printed(key)} {by}" if factors else f"nothing holds {printed(key)}: no factor is on it; {missing}",
            key=key,
            factors=list(factors),
            missing=missing,
        )
