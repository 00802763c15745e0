"""Numbers of a formula while its code is made: an operator adds an instruction, once for the same operands.

A term is a number, or one that a vector register has for several scalars of the variables at once: a slope.  What is
known is computed here; a slope that is 0 needs no instruction, and neither does what is multiplied by it.  What is
divided by what may be known is divided by `over`: numbers of Python raise where one is 0.
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


class Code:
    """Where instructions go: those of numbers to one builder, those of slopes to another."""

    def __init__(self, module: Any, numbers: Any, slopes: Any) -> None:
        self.module, self.numbers, self.slopes = module, numbers, slopes
        self._made: dict[tuple[Any, ...], Term] = {}

    def number(self, value: Any) -> Term:
        """A number that an instruction gave."""
        return Term(self, value, False)

    def slope(self, value: Any) -> Term:
        """Slopes that an instruction gave."""
        return Term(self, value, True)

    def once(self, operation: str, wide: bool, operands: tuple[Operand, ...], make: Any) -> Term:
        """What `make(builder, values of the operands)` gives, made once."""
        key = (operation, wide, *(_identity(operand) for operand in operands))
        if key not in self._made:
            builder = self.slopes if wide else self.numbers
            values = [self._value(operand, wide) for operand in operands]
            self._made[key] = Term(self, make(builder, values), wide)
        return self._made[key]

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
    """A number, or slopes (`wide`), with its instruction's value."""

    __slots__ = ("code", "value", "wide")

    def __init__(self, code: Code, value: Any, wide: bool) -> None:
        self.code, self.value, self.wide = code, value, wide

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
        return self.code.once("fneg", self.wide, (self,), lambda builder, of: builder.fneg(*of, flags=_MAY))


def _identity(operand: Operand) -> Any:
    return id(operand.value) if isinstance(operand, Term) else ("number", operand, math.copysign(1.0, operand))


def _is(operand: Operand, number: float) -> bool:
    return not isinstance(operand, Term) and operand == number


def _instruction(name: str, a: Operand, b: Operand) -> Operand:
    terms = [operand for operand in (a, b) if isinstance(operand, Term)]
    if not terms:
        return _FOLDED[name](a, b)
    wide = any(term.wide for term in terms)
    return terms[0].code.once(name, wide, (a, b), lambda builder, of: getattr(builder, name)(*of, flags=_MAY))


def plus(a: Operand, b: Operand) -> Operand:
    """a + b"""
    return b if _is(a, 0.0) else a if _is(b, 0.0) else _instruction("fadd", a, b)


def minus(a: Operand, b: Operand) -> Operand:
    """a − b"""
    return -b if _is(a, 0.0) else a if _is(b, 0.0) else _instruction("fsub", a, b)


def times(a: Operand, b: Operand) -> Operand:
    """a b; 0 where one of them is always 0."""
    if _is(a, 0.0) or _is(b, 0.0):
        return 0.0
    if _is(a, 1.0) or _is(a, -1.0):
        return b if _is(a, 1.0) else -b
    if _is(b, 1.0) or _is(b, -1.0):
        return a if _is(b, 1.0) else -a
    return _instruction("fmul", a, b)


def over(a: Operand, b: Operand) -> Operand:
    """a / b; 0 where a is always 0, though b may be too."""
    if isinstance(a, Term) or isinstance(b, Term):
        return 0.0 if _is(a, 0.0) else a if _is(b, 1.0) else _instruction("fdiv", a, b)
    return a / b if b != 0.0 else math.nan


def root(a: Operand) -> Operand:
    """√a of what is not negative."""
    if not isinstance(a, Term):
        return math.sqrt(a) if a >= 0.0 else math.nan
    return _call("llvm.sqrt.f64", a)


def sine(a: Operand) -> Operand:
    """sin a"""
    return _call("sin", a) if isinstance(a, Term) else math.sin(a) if math.isfinite(a) else math.nan


def cosine(a: Operand) -> Operand:
    """cos a"""
    return _call("cos", a) if isinstance(a, Term) else math.cos(a) if math.isfinite(a) else math.nan


def angle_of(y: Operand, x: Operand) -> Operand:
    """The angle of (x, y)."""
    return _call("atan2", y, x) if isinstance(y, Term) or isinstance(x, Term) else math.atan2(y, x)


def floor(a: Operand) -> Operand:
    """The largest integer that is not above a."""
    return _call("llvm.floor.f64", a) if isinstance(a, Term) else float(math.floor(a)) if math.isfinite(a) else math.nan


def pick(a: Operand, comparison: str, b: Operand, yes: Operand, no: Operand) -> Operand:
    """`yes` where a `comparison` b, of numbers, else `no`; `yes` and `no` are numbers or slopes."""
    if not isinstance(a, Term) and not isinstance(b, Term):
        return yes if {"<": a < b, ">=": a >= b, ">": a > b}[comparison] else no
    if not isinstance(yes, Term) and not isinstance(no, Term) and yes == no:
        return yes  # zeros of either sign too: a slope that is 0 is none
    code = next(term.code for term in (a, b) if isinstance(term, Term))
    holds = code.once(f"fcmp {comparison}", False, (a, b), lambda builder, of: builder.fcmp_ordered(comparison, *of))
    wide = any(isinstance(term, Term) and term.wide for term in (yes, no))
    key = (yes, no)
    return code.once(f"select {id(holds.value)}", wide, key, lambda builder, of: builder.select(holds.value, *of))


def _call(name: str, *of: Operand) -> Operand:
    code = next(term.code for term in of if isinstance(term, Term))
    return code.once(name, False, of, lambda builder, values: builder.call(code.function(name, len(values)), values))
