"""The function of a kind in LLVM's language: its residual, and what is made of its Jacobian.  MATH §3.11.

    function(x, var, fac, z, out, asked, was, information, delta) -> NO_NUMBER, RESIDUAL or BOTH

x: all values; var: the table of variables; fac: the rows of the factor; z: what is measured; out: r (dim,).  What is
given says what of r and J is a number of at most MOST_RESIDUAL.  asked: SLOPES, behind r also J
(dim, scalars), row by row, with room for a vector register after it; ERROR, how far both are from the linear model
that is kept, see `error_code`, which the last three arguments are for; SQUARE, rᵀ Ω r alone, which is what is given
then, −∞ where r is none: nothing is written.

The numbers come first.  Then the slopes, forward mode: for as many scalars of the variables at once as a vector
register has lanes, in a loop from the last scalars to the first, so that what a row's last vector writes beyond the
row is written anew.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from factorbus.proto.expressions.declaration import CONSTANT, Declaration, ExpressionNode
from factorbus.proto.expressions.operations import SO3, Type, tangent_size, value_size
from factorbus.solver.formulas import groups, vectors
from factorbus.solver.formulas.error_code import ErrorCode
from factorbus.solver.formulas.groups import Dual
from factorbus.solver.formulas.terms import DOUBLE, INTEGER, LANES, NO_SLOPE, WIDE, Code, Operand, Term
from factorbus.solver.kernels.jit.compile import ir
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import BOTH, ERROR, NO_NUMBER, RESIDUAL, SQUARE

# A residual beyond it, or a slope, is no number to add to a sum of squares.
MOST_RESIDUAL = 1e12
NAME = "factorbus_residual"

_NUMBER, _WORD, _BITS = DOUBLE.as_pointer(), INTEGER.as_pointer(), ir.VectorType(ir.IntType(1), LANES)


def residual_code(declared: Declaration) -> str:
    """The module with the function."""
    module = ir.Module(NAME)
    kind = ir.FunctionType(INTEGER, [_NUMBER, _WORD, _WORD, _NUMBER, _NUMBER, INTEGER, _NUMBER, _NUMBER, _NUMBER])
    function = ir.Function(module, kind, NAME)
    x, var, fac, z, out, asked, was, information, delta = function.args
    names = ["numbers", "square", "residual", "begin_error", "slopes", "store", "add_error", "next", "all"]
    names += ["end_error", "end"]
    blocks = {name: function.append_basic_block(name) for name in names}
    at_block = {name: ir.IRBuilder(block) for name, block in blocks.items()}
    at_entry, in_loop, at_next = at_block["numbers"], at_block["slopes"], at_block["next"]
    code = Code(module, at_entry, in_loop)
    sizes = [tangent_size(kind) for kind in declared.types[: len(declared.variables)]]

    # 1. What is known: the variables, with a slope of 1 at each of their scalars, and what is measured.
    last = INTEGER(-(-declared.scalars // LANES) - 1)
    block, all_within = in_loop.phi(INTEGER, "block"), in_loop.phi(_BITS, "within")
    known: list[Dual] = []
    rows: list[Any] = []
    for n, size in enumerate(sizes):
        v = at_entry.load(at_entry.gep(fac, [INTEGER(at.F_I if n == 0 else (n - 1) * at.F_WIDTH + at.F_J)]))
        rows.append(at_entry.mul(v, INTEGER(at.V_WIDTH)))
        place = at_entry.load(at_entry.gep(var, [at_entry.add(rows[n], INTEGER(at.V_AT))]))
        d = [_seed(code, block, sum(sizes[:n]) + c) for c in range(size)]
        known.append(Dual(_loaded(code, x, place, value_size(declared.types[n])), d))
    measured = declared.measured
    known.append(Dual(_loaded(code, z, INTEGER(0), value_size(measured)), [NO_SLOPE] * tangent_size(measured)))

    # 2. Each node of those before it.
    for node in declared.nodes:
        of = [known[k] for k in node.of]
        known.append(_carry_out(node, [declared.types[k] for k in node.of], of))

    # 3. The residual, and whether it is one.
    residual, within = [_value(number, DOUBLE) for number in known[-1].v], ir.IntType(1)(1)
    for value in residual:
        within = at_entry.and_(within, _is_within(code, at_entry, value, DOUBLE))
    error = ErrorCode(at_entry, sizes, len(residual), was, information, delta, out)
    pulling = [at_entry.select(within, value, DOUBLE(0.0)) for value in residual]
    at_entry.cbranch(_is(at_entry, asked, SQUARE), blocks["square"], blocks["residual"])
    square, written = at_block["square"], at_block["residual"]
    found = square.select(within, error.square(square, residual), DOUBLE(-math.inf))
    square.ret(square.bitcast(found, INTEGER))
    for a, value in enumerate(residual):
        written.store(value, written.gep(out, [INTEGER(a)]))
    written.cbranch(_is(written, asked, ERROR), blocks["begin_error"], blocks["slopes"])
    error.begin(at_block["begin_error"], var, rows, pulling)
    at_block["begin_error"].branch(blocks["slopes"])

    # 4. The Jacobian, from the last block of scalars on: stored, or held against what it was.
    now: Any = all_within
    slopes = [_value(slope, WIDE) for slope in known[-1].d]
    for slope in slopes:
        now = in_loop.and_(now, _is_within(code, in_loop, slope, WIDE))
    in_loop.cbranch(_is(in_loop, asked, ERROR), blocks["add_error"], blocks["store"])
    store = at_block["store"]
    column = store.mul(block, INTEGER(LANES))
    for a, slope in enumerate(slopes):
        here = store.gep(out, [store.add(column, INTEGER(len(residual) + a * declared.scalars))])
        store.store(slope, store.bitcast(here, WIDE.as_pointer()), align=8)
    store.branch(blocks["next"])
    error.add(at_block["add_error"], block, slopes)
    at_block["add_error"].branch(blocks["next"])
    following = at_next.sub(block, INTEGER(1))
    for before in ("residual", "begin_error"):
        block.add_incoming(last, at_block[before].block)
        all_within.add_incoming(ir.Constant(_BITS, [1] * LANES), at_block[before].block)
    block.add_incoming(following, blocks["next"])
    all_within.add_incoming(now, blocks["next"])
    at_next.cbranch(at_next.icmp_signed(">=", following, INTEGER(0)), blocks["slopes"], blocks["all"])

    # 5. Which of both are numbers.
    at_all, at_end = at_block["all"], at_block["end"]
    lanes = at_all.bitcast(now, ir.IntType(LANES))
    also = at_all.icmp_unsigned("==", lanes, ir.Constant(ir.IntType(LANES), (1 << LANES) - 1))
    at_all.cbranch(_is(at_all, asked, ERROR), blocks["end_error"], blocks["end"])
    finish = at_block["end_error"]
    error.end(finish, pulling, finish.and_(within, also))
    finish.branch(blocks["end"])
    number = at_end.select(also, INTEGER(BOTH), INTEGER(RESIDUAL))
    at_end.ret(at_end.select(within, number, INTEGER(NO_NUMBER)))
    return str(module)


def _is(builder: Any, asked: Any, what: int) -> Any:
    return builder.icmp_signed("==", asked, INTEGER(what))


def _loaded(code: Code, first: Any, place: Any, count: int) -> list[Operand]:
    builder = code.numbers
    return [code.number(builder.load(builder.gep(first, [builder.add(place, INTEGER(c))]))) for c in range(count)]


def _seed(code: Code, block: Any, scalar: int) -> Term:
    """1 in the lane of this scalar, where it is in the block."""
    builder = code.slopes
    here = builder.icmp_signed("==", block, INTEGER(scalar // LANES))
    one = [1.0 if lane == scalar % LANES else 0.0 for lane in range(LANES)]
    return code.slope(builder.select(here, ir.Constant(WIDE, one), ir.Constant(WIDE, [0.0] * LANES)))


def _value(operand: Operand, kind: Any) -> Any:
    if isinstance(operand, Term):
        return operand.value
    return ir.Constant(kind, [operand] * LANES if kind is WIDE else operand)


def _is_within(code: Code, builder: Any, value: Any, kind: Any) -> Any:
    name = "llvm.fabs.f64" if kind is DOUBLE else f"llvm.fabs.v{LANES}f64"
    known = code.module.globals.get(name) or ir.Function(code.module, ir.FunctionType(kind, [kind]), name)
    most = ir.Constant(kind, MOST_RESIDUAL if kind is DOUBLE else [MOST_RESIDUAL] * LANES)
    return builder.fcmp_ordered("<=", builder.call(known, [value]), most)


def _carry_out(node: ExpressionNode, kinds: Sequence[Type], of: Sequence[Dual]) -> Dual:
    if node.operation == CONSTANT:
        return Dual(list(node.numbers), [NO_SLOPE] * len(node.numbers))
    return _DO[node.operation](kinds, [int(number) for number in node.numbers], *of)


def _plain(function: Callable[..., Dual]) -> Callable[..., Dual]:
    return lambda _kinds, _numbers, *of: function(*of)


def _of_group(function: Callable[..., Dual]) -> Callable[..., Dual]:
    return lambda kinds, _numbers, *of: function(kinds[0], *of)


def _part(_kinds: Sequence[Type], numbers: Sequence[int], a: Dual) -> Dual:
    first, count = numbers
    return Dual(a.v[first : first + count], a.d[first : first + count])


def _logarithm(kinds: Sequence[Type], _numbers: Sequence[int], a: Dual) -> Dual:
    if kinds[0] == SO3:
        return groups.log(a)
    where = groups.position(str(kinds[0]), a)
    turn = Dual(a.v[2:], a.d[2:]) if len(a.v) == 3 else groups.log(Dual(a.v[3:], a.d[3:]))
    return _joined(where, turn)


def _joined(*of: Dual) -> Dual:
    return Dual([x for dual in of for x in dual.v], [x for dual in of for x in dual.d])


def _added(sign: float) -> Callable[[Dual, Dual], Dual]:
    return lambda a, b: Dual(*([x + sign * y for x, y in zip(*parts, strict=True)] for parts in zip(a, b, strict=True)))


_DO: dict[str, Callable[..., Dual]] = {
    "compose": _of_group(groups.compose_dual),
    "inverse": _of_group(groups.inverse_dual),
    "act": lambda kinds, _numbers, a, b: groups.rotate(kinds[0], a, b, moves=kinds[0] != SO3),
    "rotate": _of_group(groups.rotate),
    "position": _of_group(groups.position),
    "rotation": _plain(lambda a: Dual(a.v[3:], a.d[3:])),
    "heading": _plain(lambda a: Dual(a.v[2:], a.d[2:])),
    "pose": _plain(groups.pose_dual),
    "log": _logarithm,
    "exp": _plain(groups.exp),
    "vector_part": _plain(groups.vector_part),
    "norm": _plain(vectors.norm),
    "dot": _plain(vectors.dot),
    "cross": _plain(vectors.cross_dual),
    "atan2": _plain(vectors.atan2),
    "sqrt": _plain(vectors.sqrt),
    "sin": _plain(vectors.sin),
    "cos": _plain(vectors.cos),
    "wrap": _plain(lambda a: Dual([groups.wrapped_angle(a.v[0])], a.d)),
    "select": _plain(vectors.select),
    "add": _plain(_added(1.0)),
    "subtract": _plain(_added(-1.0)),
    "negate": _plain(lambda a: Dual(*([-x for x in part] for part in a))),
    "multiply": _plain(vectors.multiply_dual),
    "divide": _plain(vectors.divide),
    "part": _part,
    "vector": _plain(_joined),
}
