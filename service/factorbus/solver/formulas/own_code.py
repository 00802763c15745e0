"""The code of own kinds in this process: made when a graph has the kind, and kept while one has."""

import hashlib
from functools import lru_cache
from weakref import WeakValueDictionary

import numpy as np

from factorbus.proto.expressions.declaration import Declaration
from factorbus.proto.expressions.formula import read_formula, write_formula
from factorbus.proto.expressions.frames import moving_ends
from factorbus.proto.expressions.operations import SE2, SE3, SO3, value_size
from factorbus.solver import errors
from factorbus.solver.formulas.residual import NAME, residual_code
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.jit.machine_code import MachineCode, TooManyFunctions, one_at_a_time
from factorbus.solver.kernels.model import expression_layout as at

# Whose graphs are gone are kept for a while: what a graph was copied from may still be read.
_KEPT = 256
# A pose, whose turn says how far a linear model of what it sees holds, (9.21), and what it sees.
_SEEN = ((SE2, SE2), (SE2, "point2"), (SE3, SE3), (SE3, "point3"))
_LESS = "drop a map that has others, or use another service"


class OwnCode:
    """Held by a graph for as long as it may have factors of the kind."""

    def __init__(self, formula: str) -> None:
        self.formula, self.number = formula, _number_of(formula)
        self._code = MachineCode(self.number, residual_code(read_formula(formula)), NAME)

    def __reduce__(self) -> tuple[object, ...]:
        """In another process it is another one."""
        return own_code_of, (self.formula,)


@lru_cache(maxsize=256)
def number_of(declared: Declaration) -> int:
    """A number that is the same in every process."""
    return _number_of(write_formula(declared))


@lru_cache(maxsize=256)
def own_head(declared: Declaration) -> F64:
    """What stands in a factor's payload before what it measures; read-only."""
    head = np.zeros(at.X_WIDTH)
    head[at.X_BEFORE] = at.X_WIDTH + value_size(declared.measured)
    head[at.X_NUMBER] = number_of(declared)
    head[at.X_QUATERNION] = {SO3: 0, SE3: 3}.get(str(declared.measured), -1)
    head[at.X_RIGID] = _is_rigid(declared)
    head.flags.writeable = False
    return head


def _is_rigid(declared: Declaration) -> bool:
    """Whether it is of a pose and of what that sees, and does not notice where in the world both are."""
    kinds = [kind for _, kind in declared.variables]
    return len(kinds) == 2 and (kinds[0], kinds[1]) in _SEEN and moving_ends(declared) == (0, 1)


def own_code_of(formula: str) -> OwnCode:
    """The code of the kind with this formula.

    Raises KindTaken: another formula of the process has its number; TooLarge: the process has no room for another.
    """
    with one_at_a_time:  # else two threads could have two formulas of one number
        if (there := _THERE.get(formula)) is not None:
            return there
        number = _number_of(formula)
        for other in _THERE.values():
            if other.number == number:
                raise errors.KindTaken(formula, other.formula, formula)
        try:
            return _made(formula)
        except TooManyFunctions:
            raise errors.TooLarge("the process", len(_THERE) + 1, len(_THERE), "own kinds", _LESS) from None


def is_made(formula: str) -> bool:
    """Whether the process has its code."""
    return formula in _THERE


@lru_cache(maxsize=256)
def _number_of(formula: str) -> int:
    return int.from_bytes(hashlib.sha256(formula.encode()).digest()[: at.NUMBER_BITS // 8], "little")


@lru_cache(maxsize=_KEPT)
def _made(formula: str) -> OwnCode:
    return _THERE.setdefault(formula, OwnCode(formula))


_THERE: WeakValueDictionary[str, OwnCode] = WeakValueDictionary()
