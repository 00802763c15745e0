"""The functions of `tiles` as LLVM, without range checks.  The size of a tile is chosen at run time by a switch."""

from typing import Any, NamedTuple

from factorbus.solver.kernels.jit import simd_llvm as simd
from factorbus.solver.kernels.jit.compile import cgutils, intrinsic, ir, types

_I64 = ir.IntType(64)
_RUN = ir.VectorType(ir.DoubleType(), 4)
_INT = types.int64
_LINE = 8  # doubles in a line of the cache
STRIP = min(4, simd.LANES)  # rows that are transposed together
_PTR, _INT_PTR = ir.DoubleType().as_pointer(), _I64.as_pointer()
_PRODUCTS = {m * 4 + v: (m, v) for m in (1, 2, 3, 4) for v in (1, 2, 3)}
_HEIGHTS = {m: (m,) for m in (1, 2, 3, 4)}


class _Product(NamedTuple):
    """A product as LLVM's values: where C, X and Y begin and how far apart their rows, and X's columns, are."""

    c: Any
    ldc: Any
    x: Any
    row: Any
    column: Any
    y: Any
    ldy: Any
    depth: Any


@intrinsic
def copy_runs(
    _typing: Any, a: Any, _rows: Any, _target: Any, _ldt: Any, _source: Any, _lds: Any, runs: Any
) -> Any:  # fmt: skip
    """Four doubles each, of some rows: see `tiles_plain.copy_runs`"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, rows, target, ldt, source, lds, pairs = args
        target, source = (simd._address(context, builder, signature, array, where) for where in (target, source))
        pairs = context.make_array(runs)(context, builder, pairs)
        count = builder.sdiv(pairs.nitems, _I64(2))
        given = [target, ldt, source, lds, pairs.data, count]
        simd._switch(builder, rows, "factorbus_copy_runs", _HEIGHTS, given, _build_copy_runs)
        return context.get_dummy_value()

    return types.void(a, *[_INT] * 5, runs), emit


@intrinsic
def transpose(
    _typing: Any, a: Any, _rows: Any, _columns: Any, _source: Any, _step: Any, _target: Any, _ld: Any
) -> Any:  # fmt: skip
    """See `tiles_plain.transpose`"""
    return _transposed(a, "factorbus_transpose", negative=False)


@intrinsic
def transpose_negative(
    _typing: Any, a: Any, _rows: Any, _columns: Any, _source: Any, _step: Any, _target: Any, _ld: Any
) -> Any:  # fmt: skip
    """See `tiles_plain.transpose_negative`"""
    return _transposed(a, "factorbus_transpose_negative", negative=True)


@intrinsic
def copy_vectors(_typing: Any, a: Any, _target: Any, _source: Any, _count: Any) -> Any:
    """`count` vectors: see `tiles_plain.copy_vectors`"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        target, source = (simd._address(context, builder, signature, args[0], where) for where in args[1:3])
        function = simd._define(builder, "factorbus_copy_vectors", [_PTR, _PTR, _I64], _build_copy_vectors)
        builder.call(function, [target, source, args[3]])
        return context.get_dummy_value()

    return types.void(a, _INT, _INT, _INT), emit


@intrinsic
def prefetch(_typing: Any, b: Any, _first: Any, _count: Any) -> Any:
    """b[first : first+count] is read soon"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        start = simd._address(context, builder, signature, args[0], args[1])
        builder.call(simd._define(builder, "factorbus_prefetch", [_PTR, _I64], _build_prefetch), [start, args[2]])
        return context.get_dummy_value()

    return types.void(b, _INT, _INT), emit


@intrinsic
def subtract_product(_typing: Any, a: Any, C: Any, b: Any, X: Any, Y: Any, _depth: Any) -> Any:
    """C −= X Y in registers: see `tiles_plain.subtract_product`"""
    return _product(types.void(a, C, b, X, Y, _INT), "factorbus_subtract", fresh=False)


@intrinsic
def negative_product(_typing: Any, a: Any, C: Any, b: Any, X: Any, Y: Any, _depth: Any) -> Any:
    """C = −X Y: see `tiles_plain.negative_product`"""
    return _product(types.void(a, C, b, X, Y, _INT), "factorbus_negative", fresh=True)


@intrinsic
def solve_tile_upper(_typing: Any, a: Any, C: Any, b: Any, _u: Any, _ldu: Any) -> Any:
    """C = U⁻¹ C: see `tiles_plain.solve_tile_upper`"""
    return _solution(types.void(a, C, b, _INT, _INT), "factorbus_solve_upper", _build_upper)


@intrinsic
def solve_tile_lower(_typing: Any, a: Any, C: Any, b: Any, _u: Any, _ldu: Any) -> Any:
    """C = U⁻ᵀ C: see `tiles_plain.solve_tile_lower`"""
    return _solution(types.void(a, C, b, _INT, _INT), "factorbus_solve_lower", _build_lower)


def _product(signature: Any, name: str, fresh: bool) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, tile, other, left, right, depth = args
        (rows, vectors, c, ldc), (x, row, column), (y, ldy) = (_fields(builder, each) for each in (tile, left, right))
        c, y = (simd._address(context, builder, signature, array, where) for where in (c, y))
        x = _address(context, builder, signature.args[2], other, x)
        case = builder.add(builder.mul(rows, _I64(4)), vectors)
        given = _Product(c, ldc, x, row, column, y, ldy, depth)
        build = lambda inner, shape, *at: _build_product(inner, shape, _Product(*at), fresh)  # noqa: E731
        simd._switch(builder, case, name, _PRODUCTS, [*given], build)
        return context.get_dummy_value()

    return signature, emit


def _solution(signature: Any, name: str, build: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, tile, other, u, ldu = args
        rows, vectors, c, ldc = _fields(builder, tile)
        c = simd._address(context, builder, signature, array, c)
        u = _address(context, builder, signature.args[2], other, u)
        simd._switch(builder, rows, name, _HEIGHTS, [c, ldc, u, ldu, vectors], build)
        return context.get_dummy_value()

    return signature, emit


def _fields(builder: Any, operand: Any) -> list[Any]:
    """The numbers of an operand, in their order."""
    return cgutils.unpack_tuple(builder, operand)


def _transposed(a: Any, name: str, negative: bool) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, rows, columns, source, step, target, ld = args
        source, target = (simd._address(context, builder, signature, array, where) for where in (source, target))
        given = [rows, columns, source, step, target, ld]
        kinds = [arg.type for arg in given]
        build = lambda inner, *args: _build_transpose(inner, *args, negative=negative)  # noqa: E731
        builder.call(simd._define(builder, name, kinds, build), given)
        return context.get_dummy_value()

    return types.void(a, *[_INT] * 6), emit


def _build_copy_runs(
    builder: Any, shape: tuple[int], target: Any, ldt: Any, source: Any, lds: Any, pairs: Any, count: Any
) -> None:
    with simd._loop(builder, _I64(0), count, 1) as (k, _carried):
        pair = builder.gep(pairs, [builder.mul(k, _I64(2))])
        start, into = (builder.load(builder.gep(pair, [_I64(n)])) for n in (0, 1))
        for i in range(shape[0]):
            line, out = (builder.add(at, builder.mul(ld, _I64(i))) for at, ld in ((start, lds), (into, ldt)))
            values = builder.load(builder.bitcast(builder.gep(source, [line]), _RUN.as_pointer()), align=8)
            builder.store(values, builder.bitcast(builder.gep(target, [out]), _RUN.as_pointer()), align=8)


def _build_transpose(
    builder: Any, rows: Any, columns: Any, source: Any, step: Any, target: Any, ld: Any, negative: bool
) -> None:
    """STRIP rows of a vector each at a time.  At the ends the last row or column comes again, and is written last."""

    def up_to(k: Any, n: int, count: Any) -> Any:
        k, last = builder.add(k, _I64(n)), builder.sub(count, _I64(1))
        return builder.select(builder.icmp_signed("<", k, last), k, last)

    with (
        simd._loop(builder, _I64(0), rows, STRIP) as (i, _outer),
        simd._loop(builder, _I64(0), columns, simd.LANES) as (k, _inner),
    ):
        corner = builder.gep(source, [k])
        lines = [simd._load(builder, builder.gep(corner, [builder.mul(up_to(i, n, rows), step)])) for n in range(STRIP)]
        if negative:
            lines = [builder.fneg(line) for line in lines]
        strips = _woven(builder, lines)
        for n in reversed(range(simd.LANES)):
            place = builder.gep(target, [builder.add(builder.mul(up_to(k, n, columns), ld), i)])
            builder.store(strips[n], builder.bitcast(place, strips[n].type.as_pointer()), align=8)


def _woven(builder: Any, lines: list[Any]) -> list[Any]:
    """Vectors of which the n-th has the n-th lanes of all `lines`."""
    groups, size = [[line] for line in lines], 1
    while len(groups) > 1:
        groups = [
            [
                _shuffled(builder, a, b, [_lane(half, j, size) for j in range(simd.LANES)])
                for a, b in zip(first, second, strict=True)
                for half in (0, 1)
            ]
            for first, second in zip(groups[::2], groups[1::2], strict=True)
        ]
        size *= 2
    each = simd.LANES // STRIP
    return [
        _shuffled(builder, one, one, list(range(part * STRIP, (part + 1) * STRIP)))
        for one in groups[0]
        for part in range(each)
    ]


def _lane(half: int, j: int, size: int) -> int:
    """Where lane j of one half of two vectors comes from when they are interleaved by `size` lanes."""
    group = j // size
    return group % 2 * simd.LANES + half * simd.LANES // 2 + group // 2 * size + j % size


def _shuffled(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))


def _build_copy_vectors(builder: Any, target: Any, source: Any, count: Any) -> None:
    with simd._loop(builder, _I64(0), builder.mul(count, _I64(simd.LANES)), simd.LANES) as (k, _carried):
        simd._store(builder, simd._load(builder, builder.gep(source, [k])), builder.gep(target, [k]))


def _build_prefetch(builder: Any, start: Any, count: Any) -> None:
    byte, short = ir.IntType(8).as_pointer(), ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [byte, short, short, short])
    fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
    with simd._loop(builder, _I64(0), count, _LINE) as (k, _carried):
        # To be read, kept in every cache, data.
        builder.call(fetch, [builder.bitcast(builder.gep(start, [k]), byte), short(0), short(3), short(1)])


def _build_product(builder: Any, shape: tuple[int, int], at: _Product, fresh: bool) -> None:
    rows, vectors = shape
    corners = [
        builder.gep(at.c, [builder.add(builder.mul(at.ldc, _I64(i)), _I64(v * simd.LANES))])
        for i in range(rows)
        for v in range(vectors)
    ]
    nothing = ir.Constant(simd._VEC, [0.0] * simd.LANES)
    sums = [nothing if fresh else simd._load(builder, corner) for corner in corners]
    lines = [builder.gep(at.x, [builder.mul(at.row, _I64(i))]) for i in range(rows)]
    with simd._loop(builder, _I64(0), at.depth, 1, sums) as (k, carried):
        offset, across = builder.mul(k, at.ldy), builder.mul(k, at.column)
        line = [
            simd._load(builder, builder.gep(at.y, [builder.add(offset, _I64(v * simd.LANES))])) for v in range(vectors)
        ]
        for i in range(rows):
            factor = simd._spread(builder, builder.fneg(builder.load(builder.gep(lines[i], [across]))))
            for v in range(vectors):
                carried[i * vectors + v] = simd._multiply_add(builder, factor, line[v], carried[i * vectors + v])
    for corner, value in zip(corners, carried.final, strict=True):
        simd._store(builder, value, corner)


def _build_upper(builder: Any, shape: tuple[int], c: Any, ldc: Any, u: Any, ldu: Any, vectors: Any) -> None:
    _build_solution(builder, range(shape[0] - 1, -1, -1), c, ldc, u, ldu, vectors)


def _build_lower(builder: Any, shape: tuple[int], c: Any, ldc: Any, u: Any, ldu: Any, vectors: Any) -> None:
    _build_solution(builder, range(shape[0]), c, ldc, u, ldu, vectors)


def _build_solution(builder: Any, order: range, c: Any, ldc: Any, u: Any, ldu: Any, vectors: Any) -> None:
    """Row by row in `order`, each less what those before it say."""

    def entry(i: int, j: int) -> Any:
        return builder.load(builder.gep(u, [builder.add(builder.mul(ldu, _I64(i)), _I64(j))]))

    one = ir.Constant(ir.DoubleType(), 1.0)
    inverse = {i: simd._spread(builder, builder.fdiv(one, entry(i, i))) for i in order}
    minus = {
        (i, k): simd._spread(builder, builder.fneg(entry(min(i, k), max(i, k))))
        for n, i in enumerate(order)
        for k in order[:n]
    }
    with simd._loop(builder, _I64(0), vectors, 1) as (v, _carried):
        start = builder.mul(v, _I64(simd.LANES))
        places = {i: builder.gep(c, [builder.add(start, builder.mul(ldc, _I64(i)))]) for i in order}
        solved: dict[int, Any] = {}
        for i in order:
            value = simd._load(builder, places[i])
            for k in solved:
                value = simd._multiply_add(builder, minus[i, k], solved[k], value)
            solved[i] = builder.fmul(value, inverse[i])
        for i, value in solved.items():
            simd._store(builder, value, places[i])


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Of an element of an array that is not the first argument."""
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])
