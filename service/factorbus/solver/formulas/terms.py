"""Numbers of a formula while its code is made: an operator adds an instruction, once for the same operands.

A term is a number, or one that a vector register has for several scalars of the variables at once: a slope.  What is
known is computed here; a slope that there is none of, NO_SLOPE, needs no instruction, and neither does what is
multiplied by it.  A number is multiplied by 0 all the same if it may be none: 0 · NaN is NaN.  What is divided by what
may be known is divided by `over`: numbers of Python raise where one is 0.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

from factorbus.solver.kernels.jit.compile import ir, vector_lanes

LANES = vector_lanes()
DOUBLE, INTEGER = ir.DoubleType(), ir.IntType(64)
WIDE = ir.VectorType(DOUBLE, LANES)
# A product and a sum may be one instruction; nothing else is reordered.
_MAY = ("contract", "nsz")
_FOLDED = {
    "fadd": lambda a, b: a + b,
    "fsub": lambda a, b: a - b,
    "fmul": lambda a, b: a * b,
}

Operand: TypeAlias = "Term | float"

# In magnitude: what variables and measurements are within, and from where on a product may overflow.
LOADED, _MAY_OVERFLOW = 1e12, 1e300


class _NoSlope(float):
    """0, also where it is multiplied by what is no number."""

    def __mul__(self, _other: object) -> _NoSlope:
        return self

    __rmul__ = __truediv__ = __mul__

    def __add__(self, other: Any) -> Any:
        return other

    __radd__ = __rsub__ = __add__

    def __sub__(self, other: Any) -> Any:
        return -other

    def __neg__(self) -> _NoSlope:
        return self


# What does not change with the variables has this slope.
NO_SLOPE = _NoSlope(0.0)


class Code:
    """Where instructions go: those of numbers to one builder, those of slopes to another."""

    def __init__(self, module: Any, numbers: Any, slopes: Any) -> None:
        self.module, self.numbers, self.slopes = module, numbers, slopes
        self._made: dict[tuple[Any, ...], Term] = {}

    def number(self, value: Any) -> Term:
        """A number that was loaded."""
        return Term(self, value, False, LOADED)

    def slope(self, value: Any) -> Term:
        """Slopes that an instruction gave."""
        return Term(self, value, True)

    def once(
        self, operation: str, wide: bool, operands: tuple[Operand, ...], make: Any, most: float = math.inf
    ) -> Term:
        """What `make(builder, values of the operands)` gives, at most `most`, made once."""
        key = (operation, wide, *(_identity(operand) for operand in operands))
        if key not in self._made:
            builder = self.slopes if wide else self.numbers
            values = [self._value(operand, wide) for operand in operands]
            self._made[key] = Term(self, make(builder, values), wide, most)
        return self._made[key]

    def is_made(self, operation: str, wide: bool, operands: tuple[Operand, ...]) -> bool:
        """Whether that has been asked for before."""
        return (operation, wide, *(_identity(operand) for operand in operands)) in self._made

    def function(self, name: str, arguments: int) -> Any:
        """A function of the C library, or of LLVM, of that number of numbers."""
        known = self.module.globals.get(name)
        kind = ir.FunctionType(DOUBLE, [DOUBLE] * arguments)
        return known or ir.Function(self.module, kind, name)

    def _value(self, operand: Operand, wide: bool) -> Any:
        if not isinstance(operand, Term):
            return ir.Constant(WIDE, [operand] * LANES) if wide else ir.Constant(DOUBLE, operand)
        if wide and not operand.wide:
            return self._spread(operand)
        return operand.value

    def _spread(self, number: Term) -> Any:
        key = ("spread", True, _identity(number))
        if key not in self._made:
            one = self.slopes.insert_element(ir.Constant(WIDE, ir.Undefined), number.value, ir.IntType(32)(0))
            all_of = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            spread = self.slopes.shuffle_vector(one, ir.Constant(WIDE, ir.Undefined), all_of)
            self._made[key] = Term(self, spread, True)
        return self._made[key].value


class Term:
    """A number, or slopes (`wide`), with its instruction's value.

    most: what it is within, if it was made of numbers; infinite: it may be none.
    """

    __slots__ = ("code", "most", "value", "wide")

    def __init__(self, code: Code, value: Any, wide: bool, most: float = math.inf) -> None:
        self.code, self.value, self.wide, self.most = code, value, wide, most

    def __add__(self, other: Operand) -> Operand:
        return plus(self, other)

    def __radd__(self, other: Operand) -> Operand:
        return plus(other, self)

    def __sub__(self, other: Operand) -> Operand:
        return minus(self, other)

    def __rsub__(self, other: Operand) -> Operand:
        return minus(other, self)

    def __mul__(self, other: Operand) -> Operand:
        return times(self, other)

    def __rmul__(self, other: Operand) -> Operand:
        return times(other, self)

    def __truediv__(self, other: Operand) -> Operand:
        return over(self, other)

    def __rtruediv__(self, other: Operand) -> Operand:
        return over(other, self)

    def __neg__(self) -> Operand:
        return self.code.once("fneg", self.wide, (self,), lambda builder, of: builder.fneg(*of, flags=_MAY), self.most)


def _identity(operand: Operand) -> Any:
    return id(operand.value) if isinstance(operand, Term) else ("number", operand, math.copysign(1.0, operand))


def _is(operand: Operand, number: float) -> bool:
    return not isinstance(operand, Term) and operand == number


def _most(operand: Operand) -> float:
    if isinstance(operand, Term):
        return operand.most
    return abs(operand) if math.isfinite(operand) else math.inf


def _instruction(name: str, a: Operand, b: Operand) -> Operand:
    terms = [operand for operand in (a, b) if isinstance(operand, Term)]
    if not terms:
        return _FOLDED[name](a, b)
    wide, most = any(term.wide for term in terms), math.inf
    if name != "fdiv":
        most = _most(a) * _most(b) if name == "fmul" else _most(a) + _most(b)
        most = most if most < _MAY_OVERFLOW else math.inf
    if name == "fmul" and terms[0].code.is_made(name, wide, (b, a)):
        a, b = b, a
    return terms[0].code.once(name, wide, (a, b), lambda builder, of: getattr(builder, name)(*of, flags=_MAY), most)


def plus(a: Operand, b: Operand) -> Operand:
    """a + b"""
    return b if _is(a, 0.0) else a if _is(b, 0.0) else _instruction("fadd", a, b)


def minus(a: Operand, b: Operand) -> Operand:
    """a − b"""
    if a is b and isinstance(a, Term) and math.isfinite(a.most):
        return 0.0  # else the processor may take a product from itself before that is rounded
    return -b if _is(a, 0.0) else a if _is(b, 0.0) else _instruction("fsub", a, b)


def times(a: Operand, b: Operand) -> Operand:
    """a b; NO_SLOPE where one of them is, or a slope is taken 0 times."""
    if a is NO_SLOPE or b is NO_SLOPE:
        return NO_SLOPE
    for zero, other in ((a, b), (b, a)):
        if _is(zero, 0.0) and isinstance(other, Term):
            if other.wide:
                return NO_SLOPE
            if math.isfinite(other.most):
                return 0.0
    if _is(a, 1.0) or _is(a, -1.0):
        return b if _is(a, 1.0) else -b
    if _is(b, 1.0) or _is(b, -1.0):
        return a if _is(b, 1.0) else -a
    return _instruction("fmul", a, b)


def over(a: Operand, b: Operand) -> Operand:
    """a / b; NO_SLOPE where a is."""
    if a is NO_SLOPE:
        return NO_SLOPE
    if isinstance(a, Term) or isinstance(b, Term):
        return a if _is(b, 1.0) else _instruction("fdiv", a, b)
    return a / b if b != 0.0 else math.nan


def reciprocal(a: Operand) -> Operand:
    """1 / a; NaN where a is 0."""
    return pick(a, "==", 0.0, math.nan, over(1.0, a))


def root(a: Operand) -> Operand:
    """√a; NaN where a is negative."""
    if not isinstance(a, Term):
        return math.sqrt(a) if a >= 0.0 else math.nan
    return _call("llvm.sqrt.f64", a)


def sine(a: Operand) -> Operand:
    """sin a"""
    return _call("sin", a, most=1.0) if isinstance(a, Term) else math.sin(a) if math.isfinite(a) else math.nan


def cosine(a: Operand) -> Operand:
    """cos a"""
    return _call("cos", a, most=1.0) if isinstance(a, Term) else math.cos(a) if math.isfinite(a) else math.nan


def angle_of(y: Operand, x: Operand) -> Operand:
    """The angle of (x, y)."""
    return _call("atan2", y, x, most=math.pi) if isinstance(y, Term) or isinstance(x, Term) else math.atan2(y, x)


def floor(a: Operand) -> Operand:
    """The largest integer that is not above a."""
    return _call("llvm.floor.f64", a) if isinstance(a, Term) else float(math.floor(a)) if math.isfinite(a) else math.nan


def pick(a: Operand, comparison: str, b: Operand, yes: Operand, no: Operand) -> Operand:
    """`yes` where a `comparison` b, of numbers, else `no`; `yes` and `no` are numbers or slopes."""
    if not isinstance(a, Term) and not isinstance(b, Term):
        return yes if {"<": a < b, ">=": a >= b, ">": a > b, "==": a == b}[comparison] else no
    if not isinstance(yes, Term) and not isinstance(no, Term) and yes == no:
        return NO_SLOPE if no is NO_SLOPE else yes  # also of zeros of either sign
    code = next(term.code for term in (a, b) if isinstance(term, Term))
    holds = code.once(f"fcmp {comparison}", False, (a, b), lambda builder, of: builder.fcmp_ordered(comparison, *of))
    wide = any(isinstance(term, Term) and term.wide for term in (yes, no))
    key, most = (yes, no), max(_most(yes), _most(no))
    return code.once(f"select {id(holds.value)}", wide, key, lambda builder, of: builder.select(holds.value, *of), most)


def _call(name: str, *of: Operand, most: float = math.inf) -> Operand:
    """most: of what it gives for numbers."""
    code = next(term.code for term in of if isinstance(term, Term))
    most = most if all(math.isfinite(_most(each)) for each in of) else math.inf

    def make(builder: Any, values: Any) -> Any:
        return builder.call(code.function(name, len(values)), values)

    return code.once(name, False, of, make, most)
