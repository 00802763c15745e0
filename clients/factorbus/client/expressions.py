"""A factor kind of one's own, written as a Python function that is called once, with expressions in place of numbers.

    from factorbus.client.expressions import SE3, Point3, Vector, factor, norm

    @factor
    def range_with_bias(a: SE3, l: Point3, bias: Vector[1], z: Vector[1]):
        return norm(a.inverse().act(l)) + bias - z

The parameter z is what is measured; the others are the variables, in this order.  What is returned is the residual: a
number or a vector, a list of them, or a pose or rotation, which stands for its `log`.  The function is not sent, its
formula is (`factorbus.proto.expressions.formula`), and it may not look at values: Python's `if` cannot see them,
`select` can.  What Python or NumPy would compute raises BadExpression, which says how it is written (`not_computed`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, TypeAlias, cast, get_type_hints

from factorbus.client.not_computed import NotComputed, no_attribute, no_numpy
from factorbus.proto.expressions.declaration import CONSTANT, MEASURED, BadExpression, ExpressionNode, declare, type_of
from factorbus.proto.expressions.operations import GROUPS, OPERATIONS, Mismatch, Type, name_of, value_size
from factorbus.proto.kinds import FactorKind, own_kind

Operand: TypeAlias = "Expression | float | Sequence[float]"


class _Trace:
    """The nodes so far; the same operation on the same nodes is one node."""

    def __init__(self, types: list[Type]) -> None:
        self.types, self.first, self.nodes = types, len(types), list[ExpressionNode]()
        self._known: dict[ExpressionNode, int] = {}

    def add(self, node: ExpressionNode, kind: Type) -> Expression:
        if node not in self._known:
            self._known[node] = len(self.types)
            self.types.append(kind)
            self.nodes.append(node)
        return Expression(self, self._known[node])


# What NumPy makes of `array * expression` and such.
_UFUNCS = {name: name for name in ("add", "subtract", "multiply", "divide")} | {"true_divide": "divide"}


class Expression(NotComputed):
    """Something that is computed of variables and of what is measured."""

    # Of an annotation: the kind of variable that it stands for, and the type that it is of what is measured.
    named: ClassVar[str] = ""
    measures: ClassVar[Type] = 0

    def __init__(self, trace: _Trace, node: int) -> None:
        self._trace, self._node = trace, node

    @property
    def kind(self) -> Type:
        """Its type: "so3", "se2", "se3", or how many numbers it is."""
        return self._trace.types[self._node]

    def __len__(self) -> int:
        return value_size(self.kind)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        raise no_attribute(self.kind, name)

    def __array_ufunc__(self, ufunc: Any, method: str, *of: Any, **named: Any) -> Expression:
        if method != "__call__" or named or ufunc.__name__ not in _UFUNCS:
            raise no_numpy(ufunc.__name__)
        return _do(_UFUNCS[ufunc.__name__], *of)

    def __repr__(self) -> str:
        return f"<expression of {name_of(self.kind)}>"

    def __add__(self, other: Operand) -> Expression:
        return _do("add", self, other)

    def __radd__(self, other: Operand) -> Expression:
        return _do("add", other, self)

    def __sub__(self, other: Operand) -> Expression:
        return _do("subtract", self, other)

    def __rsub__(self, other: Operand) -> Expression:
        return _do("subtract", other, self)

    def __pos__(self) -> Expression:
        return self

    def __neg__(self) -> Expression:
        return _do("negate", self)

    def __mul__(self, other: Operand) -> Expression:
        return _do("compose" if self.kind in GROUPS else "multiply", self, other)

    def __rmul__(self, other: Operand) -> Expression:
        return _do("multiply", other, self)

    def __truediv__(self, other: Operand) -> Expression:
        return _do("divide", self, other)

    def __rtruediv__(self, other: Operand) -> Expression:
        return _do("divide", other, self)

    def __getitem__(self, index: int | slice) -> Expression:
        first, stop, step = (index if isinstance(index, slice) else slice(index, index + 1)).indices(len(self))
        if step != 1 or (isinstance(index, int) and not -len(self) <= index < len(self)):
            raise IndexError(f"{index!r} of {name_of(self.kind)}; wanted one number, or numbers one after the other")
        if isinstance(index, int) and index < 0:
            first, stop = index + len(self), index + len(self) + 1
        return _do("part", self, numbers=(first, stop - first))

    def inverse(self) -> Expression:
        """a⁻¹, of a pose or rotation."""
        return _do("inverse", self)

    def compose(self, other: Expression) -> Expression:
        """a ∘ b, of poses or rotations; the same as a * b."""
        return _do("compose", self, other)

    def between(self, other: Expression) -> Expression:
        """a⁻¹ ∘ b: b as seen from a."""
        return _do("compose", self.inverse(), other)

    def act(self, point: Operand) -> Expression:
        """A point of the frame a, in the frame that a is seen from."""
        return _do("act", self, point)

    def rotate(self, direction: Operand) -> Expression:
        """A direction of the frame a, in the frame that a is seen from."""
        return _do("rotate", self, direction)

    @property
    def position(self) -> Expression:
        """Where a pose is."""
        return _do("position", self)

    @property
    def rotation(self) -> Expression:
        """How a pose in space is turned."""
        return _do("rotation", self)

    @property
    def heading(self) -> Expression:
        """θ of a pose in the plane, radians."""
        return _do("heading", self)


class SE2(Expression):
    """A pose in the plane."""

    named, measures = "se2", "se2"


class SE3(Expression):
    """A pose in space."""

    named, measures = "se3", "se3"


class SO3(Expression):
    """A rotation in space."""

    named, measures = "so3", "so3"


class Point2(Expression):
    """A point in the plane."""

    named, measures = "point2", 2


class Point3(Expression):
    """A point in space."""

    named, measures = "point3", 3


class IDP(Expression):
    """A feature of inverse depth: (x, y, z, θ, φ, ρ)."""

    named, measures = "idp", 6


class Vector(Expression):
    """Vector[3] is a vector variable of three numbers; of z, three numbers measured."""

    def __class_getitem__(cls, size: int) -> type[Expression]:
        return type(f"Vector[{size}]", (cls,), {"named": f"vector{size}", "measures": size})


def _do(operation: str, *of: Operand, numbers: Sequence[int] = ()) -> Expression:
    """Raises BadExpression: the operation does not take these."""
    if any(isinstance(one, list | tuple) and any(isinstance(each, Expression) for each in one) for one in of):
        raise BadExpression(f"{operation}: got a list with expressions in it; wanted vector(a, b), which joins them")
    known = [one for one in of if isinstance(one, Expression)]
    if not known:
        raise BadExpression(f"{operation}: got {list(of)!r}; wanted at least one expression, Python computes the rest")
    trace = known[0]._trace
    if any(one._trace is not trace for one in known):
        raise BadExpression(f"{operation}: its expressions are of two functions; wanted those of one")
    nodes = tuple(one._node if isinstance(one, Expression) else _constant(trace, one)._node for one in of)
    kinds = [trace.types[node] for node in nodes]
    try:
        kind = OPERATIONS[operation].gives(kinds, numbers)
    except Mismatch as problem:
        raise BadExpression(f"{operation}: {problem}") from None
    return trace.add(ExpressionNode(operation, nodes, tuple(map(float, numbers))), kind)


def _constant(trace: _Trace, value: Any) -> Expression:
    given = [*value] if hasattr(value, "__len__") and not isinstance(value, str | bytes) else [value]
    try:
        numbers = tuple(map(_number, given))
    except (TypeError, ValueError):
        raise BadExpression(f"got {value!r}; wanted an expression, a number, or a list of numbers") from None
    return trace.add(ExpressionNode(CONSTANT, (), numbers), len(numbers))


def _number(given: Any) -> float:
    if isinstance(given, str | bytes):  # which float would read
        raise TypeError(f"{given!r} is text")
    return float(given)


def pose_at(position: Operand, turn: Operand) -> Expression:
    """The pose at a position with a heading, or with a rotation."""
    return _do("pose", position, turn)


def log(a: Expression) -> Expression:
    """The rotation vector of a rotation; of a pose its position, and that of its rotation behind it; of an angle."""
    return _do("log", a)


def exp(a: Operand) -> Expression:
    """The rotation by a rotation vector."""
    return _do("exp", a)


def vector_part(a: Expression) -> Expression:
    """(x, y, z) of a rotation's quaternion, its sign chosen so that w ≥ 0: the residual of `between_se3`."""
    return _do("vector_part", a)


def norm(a: Operand) -> Expression:
    """The length of a vector."""
    return _do("norm", a)


def dot(a: Operand, b: Operand) -> Expression:
    """aᵀ b."""
    return _do("dot", a, b)


def cross(a: Operand, b: Operand) -> Expression:
    """a × b; of vectors of two numbers one number."""
    return _do("cross", a, b)


def atan2(y: Operand, x: Operand) -> Expression:
    """The angle of (x, y), radians."""
    return _do("atan2", y, x)


def sqrt(a: Operand) -> Expression:
    """√a."""
    return _do("sqrt", a)


def sin(a: Operand) -> Expression:
    """Of an angle in radians."""
    return _do("sin", a)


def cos(a: Operand) -> Expression:
    """Of an angle in radians."""
    return _do("cos", a)


def wrap(a: Operand) -> Expression:
    """An angle brought into [−π, π)."""
    return _do("wrap", a)


def select(condition: Operand, a: Operand, b: Operand) -> Expression:
    """`a` where the condition is 0 or more, else `b`."""
    return _do("select", condition, a, b)


def vector(*vectors: Operand) -> Expression:
    """The numbers of all, one after the other."""
    return _do("vector", *vectors)


def factor(function: Callable[..., Any] | None = None, **keywords: Any) -> FactorKind:
    """The factor kind that a function of variables and of z writes down; it is called as the function.

    Raises BadExpression: what the function does is no such thing.
    """
    if keywords or not inspect.isfunction(function):
        seen = ", ".join(keywords) or ("nothing" if function is None else repr(function)[:80])
        raise BadExpression(
            f"factor: got {seen}; wanted @factor without parentheses, above a function: its name is that of the kind"
        )
    name, variables, measured = function.__name__, list[tuple[str, str]](), None
    for parameter, kind in _annotated(name, function):
        if parameter == MEASURED:
            measured = kind.measures
        else:
            variables.append((parameter, kind.named))
    if measured is None:
        raise BadExpression(f"{name}: nothing is measured; wanted a parameter {MEASURED}, as in {MEASURED}: Vector[1]")
    trace = _Trace([*(type_of(kind) for _, kind in variables), measured])
    given = {parameter: Expression(trace, k) for k, parameter in enumerate((*(n for n, _ in variables), MEASURED))}
    residual = _residual(name, function(**given), trace)
    return own_kind(declare(name, tuple(variables), measured, trace.nodes, residual._node))


def _annotated(name: str, function: Callable[..., Any]) -> Iterator[tuple[str, type[Expression]]]:
    """The parameters with their types.  Raises BadExpression."""
    hints = get_type_hints(function)
    for each in inspect.signature(function).parameters.values():
        parameter, kind = each.name, hints.get(each.name)
        if each.kind not in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY):
            raise BadExpression(f"{name}: {each} is a parameter; wanted one parameter for each variable, by its name")
        if each.default is not each.empty:
            raise BadExpression(
                f"{name}: {parameter} has the default {each.default!r}, which no factor would have; wanted it without: "
                "each factor says its variables and what it measures"
            )
        if not (isinstance(kind, type) and issubclass(kind, Expression) and kind.named):
            raise BadExpression(
                f"{name}: {parameter} is annotated {kind!r}; wanted SE2, SE3, Point2, Point3, IDP or Vector[1]"
            )
        yield parameter, kind


def _residual(name: str, returned: Any, trace: _Trace) -> Expression:
    parts = returned if isinstance(returned, list | tuple) else [returned]
    if not parts or not all(isinstance(one, Expression) and one._trace is trace for one in parts):
        raise BadExpression(
            f"{name}: it returned {returned!r}; wanted an expression of its variables, or a list of them"
        )
    vectors = [log(one) if one.kind in GROUPS else one for one in cast("list[Expression]", parts)]
    return vectors[0] if len(vectors) == 1 else vector(*vectors)
