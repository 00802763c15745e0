"""The instructions of an own kind, as kernels carry them out (`kernels/model/expression_layout.py`)."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from factorbus.proto.expressions.declaration import CONSTANT, Declaration, ExpressionNode
from factorbus.proto.expressions.formula import write_formula
from factorbus.proto.expressions.frames import moving_ends
from factorbus.proto.expressions.operations import OPERATIONS, SE2, SE3, SO3, Type, tangent_size, value_size
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import expression_layout as at

_ID_BITS = 48  # of a hash: exact as a float64


@dataclass(frozen=True, slots=True)
class _Value:
    """Where a node's value is, and its tangent: of which scalars of the variables it is a function."""

    kind: Type
    at: int
    row: int
    first: int
    last: int


@lru_cache(maxsize=256)
def instructions_of(declared: Declaration) -> F64:
    """All that stands in a factor's payload before what it measures; read-only."""
    made = _Made()
    for kind in declared.types[: len(declared.variables)]:
        made.place(kind, (made.rows, made.rows + tangent_size(kind)))
    measured = made.place(declared.measured, (0, 0), row=0)
    constants = [node for node in declared.nodes if node.operation == CONSTANT]
    found = {id(node): made.place(len(node.numbers), (0, 0), row=0) for node in constants}
    zeros = made.rows  # what does not change with the variables has these rows, which nothing writes
    made.rows += max(map(tangent_size, (declared.measured, *(len(node.numbers) for node in constants))))
    made.known = [_moved(value, zeros) if value is measured else value for value in made.known]
    made.known = made.known[: len(declared.parameters)]
    for node in declared.nodes:
        made.known.append(_moved(found[id(node)], zeros) if node.operation == CONSTANT else made.carry_out(node))
    numbers = [number for node in constants for number in node.numbers]
    words = [word for fields in made.instructions for word in _packed(fields)]
    head = np.zeros(at.HEAD)
    head[at.X_LENGTH] = at.HEAD + len(numbers) + len(words)
    head[at.X_BEFORE] = head[at.X_LENGTH] + value_size(declared.measured)
    head[at.X_ID] = id_of(declared)
    head[at.X_INSTRUCTIONS], head[at.X_CONSTANTS] = len(made.instructions), len(numbers)
    head[at.X_VALUES], head[at.X_ROWS] = made.values, made.rows
    head[at.X_RESIDUAL], head[at.X_RESIDUAL_ROW] = made.known[-1].at, made.known[-1].row
    head[at.X_QUATERNION] = {SO3: 0, SE3: 3}.get(declared.measured, -1) if isinstance(declared.measured, str) else -1
    head[at.X_RIGID] = len(declared.variables) == 2 and moving_ends(declared) == (0, 1)
    whole = np.concatenate([head, numbers, np.array(words, np.float64)])
    whole.flags.writeable = False
    return whole


@lru_cache(maxsize=256)
def id_of(declared: Declaration) -> int:
    """A number that is another one for each kind."""
    return int.from_bytes(hashlib.sha256(write_formula(declared).encode()).digest()[: _ID_BITS // 8], "little")


def _moved(value: _Value, row: int) -> _Value:
    return _Value(value.kind, value.at, row, value.first, value.last)


def _packed(fields: Sequence[int]) -> tuple[float, ...]:
    op, n, first, last, out, row, a, a_row, b, b_row = fields
    shift, scalar, place = at.OP_BITS + at.N_BITS, at.SCALAR_BITS, at.PLACE_BITS
    return (
        float(op | n << at.OP_BITS | first << shift | last << shift + scalar | out << shift + 2 * scalar),
        float(row | a << place | a_row << 2 * place),
        float(b | b_row << place),
    )


@dataclass
class _Made:
    """Values and instructions so far."""

    values: int = 0
    rows: int = 0
    known: list[_Value] = field(default_factory=list)
    instructions: list[tuple[int, ...]] = field(default_factory=list)

    def place(self, kind: Type, of: tuple[int, int], row: int = -1) -> _Value:
        """Room for one more value, and for its tangent unless it has a `row`."""
        value = _Value(kind, self.values, self.rows if row < 0 else row, *of)
        self.values += value_size(kind)
        if row < 0:
            self.rows += tangent_size(kind)
        self.known.append(value)
        return value

    def carry_out(self, node: ExpressionNode) -> _Value:
        """The value of a node, by instructions, or where it is a part of another."""
        of, kinds = [self.known[k] for k in node.of], [self.known[k].kind for k in node.of]
        if node.operation == "part":
            first, count = map(int, node.numbers)
            return _part(of[0], count, first, first)
        if node.operation == "rotation":
            return _part(of[0], SO3, 3, 3)
        if node.operation == "heading":
            return _part(of[0], 1, 2, 2)
        if node.operation == "log" and kinds[0] != SO3:
            where = self._do("position", 2 if kinds[0] == SE2 else 3, of)
            turn = _part(of[0], 1, 2, 2) if kinds[0] == SE2 else self._do("log", 3, [_part(of[0], SO3, 3, 3)])
            return self._joined([where, turn])
        if node.operation == "vector":
            return self._joined(of)
        if node.operation == "rotate" and kinds[0] == SE3:
            return self._do("rotate_so3", 3, [_part(of[0], SO3, 3, 3), of[1]])
        if node.operation == "select":
            return self._selected(*of)
        if node.operation == "multiply" and kinds[0] != kinds[1]:
            of = of if kinds[1] == 1 else of[::-1]
            return self._do("scale", of[0].kind, of)
        return self._do(_name_of(node.operation, kinds), _result(node.operation, kinds), of)

    def _do(self, name: str, gives: Type, of: Sequence[_Value], into: _Value | None = None) -> _Value:
        span = _span(of)
        count = of[0].kind if name in ("norm", "dot") else gives
        out = into or self._room(gives, span)
        a, b = of[0], of[1] if len(of) > 1 else of[0]
        self.instructions.append((at.CODES[name], value_size(count), *span, out.at, out.row, a.at, a.row, b.at, b.row))
        return out

    def _room(self, kind: Type, span: tuple[int, int]) -> _Value:
        value = self.place(kind, span)
        self.known.pop()
        return value

    def _joined(self, of: Sequence[_Value]) -> _Value:
        whole, start = self._room(sum(value_size(value.kind) for value in of), _span(of)), 0
        for value in of:
            self._do("copy", value.kind, [value], _part(whole, value.kind, start, start))
            start += value_size(value.kind)
        return whole

    def _selected(self, condition: _Value, yes: _Value, no: _Value) -> _Value:
        out = self._room(yes.kind, _span((yes, no)))
        self._do("copy", out.kind, [no, out], out)
        self._do("copy_where", out.kind, [yes, _Value(1, condition.at, yes.row, out.first, out.last)], out)
        return out


def _span(of: Sequence[_Value]) -> tuple[int, int]:
    """Of which scalars something is a function that is made of these."""
    changing = [value for value in of if value.last > value.first]
    return (min(value.first for value in changing), max(value.last for value in changing)) if changing else (0, 0)


def _part(value: _Value, kind: Type, start: int, row: int) -> _Value:
    return _Value(kind, value.at + start, value.row + row, value.first, value.last)


def _name_of(operation: str, kinds: Sequence[Type]) -> str:
    """What kernels call an operation on these types."""
    if operation in ("compose", "inverse", "act", "rotate"):
        return f"{'rotate' if operation == 'act' and kinds[0] == SO3 else operation}_{kinds[0]}"
    if operation == "pose":
        return "pose_se2" if kinds[0] == 2 else "pose_se3"
    if operation == "cross":
        return "cross3" if kinds[0] == 3 else "cross2"
    return operation


def _result(operation: str, kinds: Sequence[Type]) -> Type:
    """The type of what an operation gives."""
    return OPERATIONS[operation].gives(kinds, ())
