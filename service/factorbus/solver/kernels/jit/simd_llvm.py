"""The functions of `simd` as LLVM, without range checks.  The size of a tile is chosen at run time by a switch."""

from typing import Any

from factorbus.solver.kernels.jit.compile import cgutils, intrinsic, ir, types, vector_lanes
from factorbus.solver.kernels.jit.simd_plain import TRIANGLE

LANES = vector_lanes()
_F64 = ir.DoubleType()
_I64 = ir.IntType(64)
_PTR = _F64.as_pointer()
_VEC, _SIX = ir.VectorType(_F64, LANES), ir.VectorType(_F64, 6)
_INT = types.int64


@intrinsic
def zero(_typing: Any, a: Any, _i: Any, _count: Any) -> Any:
    """a[i : i+count] = 0"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        start = _address(context, builder, signature, args[0], args[1])
        cgutils.memset(builder, start, builder.mul(args[2], _I64(8)), 0)
        return context.get_dummy_value()

    return types.void(a, _INT, _INT), emit


@intrinsic
def add_run(_typing: Any, a: Any, _i: Any, _j: Any, _count: Any) -> Any:
    """a[i : i+count] += a[j : j+count]; the runs do not overlap"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        target = _address(context, builder, signature, args[0], args[1])
        source = _address(context, builder, signature, args[0], args[2])
        function = _define(builder, "factorbus_add_run", [_PTR, _PTR, _I64], _build_add_run)
        builder.call(function, [target, source, args[3]])
        return context.get_dummy_value()

    return types.void(a, _INT, _INT, _INT), emit


@intrinsic
def tile(_typing: Any, a: Any, _rows: Any, _vectors: Any, C: Any, X: Any, _y: Any) -> Any:
    """C −= XᵀY in registers: see `simd_plain.tile`"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, rows, vectors, block, panel, y = args
        c, ldc = cgutils.unpack_tuple(builder, block)
        x, ld, depth = cgutils.unpack_tuple(builder, panel)
        c, x, y = (_address(context, builder, signature, array, where) for where in (c, x, y))
        shapes = {m * 4 + v: (m, v) for m in (1, 2, 3, 4) for v in (1, 2, 3)}
        case = builder.add(builder.mul(rows, _I64(4)), vectors)
        _switch(builder, case, "factorbus_tile", shapes, [c, ldc, x, y, ld, depth], _build_tile)
        return context.get_dummy_value()

    return types.void(a, _INT, _INT, C, X, _INT), emit


@intrinsic
def solve_tile(_typing: Any, a: Any, _rows: Any, _vectors: Any, _c: Any, _ld: Any, _t: Any) -> Any:
    """C = T⁻ᵀ C: see `simd_plain.solve_tile`"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, rows, vectors, c, ld, t = args
        c, t = (_address(context, builder, signature, array, where) for where in (c, t))
        shapes = {m: (m,) for m in (1, 2, 3, 4)}
        _switch(builder, rows, "factorbus_solve", shapes, [c, ld, t, vectors], _build_solve)
        return context.get_dummy_value()

    return types.void(a, *[_INT] * 5), emit


@intrinsic
def six(_typing: Any, x: Any, X: Any, y: Any, _j: Any, out: Any, _to: Any) -> Any:
    """A row of six sums: see `simd_plain.six`"""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, panel, y, j, out, to = args
        i, stride, depth = cgutils.unpack_tuple(builder, panel)
        x = _address(context, builder, signature, x, i)
        y = _address(context, builder, signature, y, j, 2)
        out = _address(context, builder, signature, out, to, 4)
        with _loop(builder, _I64(0), depth, 1, [ir.Constant(_SIX, [0.0] * 6)]) as (k, carried):
            factor = _spread(builder, builder.load(builder.gep(x, [builder.mul(k, stride)])), _SIX)
            row = _load(builder, builder.gep(y, [builder.mul(k, _I64(6))]), _SIX)
            carried[0] = _multiply_add(builder, factor, row, carried[0])
        _store(builder, carried.final[0], out)
        return context.get_dummy_value()

    return types.void(x, X, y, _INT, out, _INT), emit


def _build_add_run(builder: Any, target: Any, source: Any, count: Any) -> None:
    """Whole vectors, then one by one."""
    whole = builder.sub(count, builder.srem(count, _I64(LANES)))
    for start, stop, step in ((_I64(0), whole, LANES), (whole, count, 1)):
        with _loop(builder, start, stop, step) as (k, _carried):
            load, store = (_load, _store) if step > 1 else (_load_one, _store_one)
            here = builder.gep(target, [k])
            store(builder, builder.fadd(load(builder, here), load(builder, builder.gep(source, [k]))), here)


def _build_tile(builder: Any, shape: tuple[int, int], c: Any, ldc: Any, x: Any, y: Any, ld: Any, depth: Any) -> None:
    rows, vectors = shape
    corners = [
        builder.gep(c, [builder.add(builder.mul(ldc, _I64(i)), _I64(v * LANES))])
        for i in range(rows)
        for v in range(vectors)
    ]
    sums = [_load(builder, corner) for corner in corners]
    with _loop(builder, _I64(0), depth, 1, sums) as (k, carried):
        offset = builder.mul(k, ld)
        line = [_load(builder, builder.gep(y, [builder.add(offset, _I64(v * LANES))])) for v in range(vectors)]
        for i in range(rows):
            factor = _spread(builder, builder.fneg(builder.load(builder.gep(x, [builder.add(offset, _I64(i))]))))
            for v in range(vectors):
                carried[i * vectors + v] = _multiply_add(builder, factor, line[v], carried[i * vectors + v])
    for corner, value in zip(corners, carried.final, strict=True):
        _store(builder, value, corner)


def _build_solve(builder: Any, shape: tuple[int], c: Any, ld: Any, t: Any, vectors: Any) -> None:
    (rows,) = shape
    entry = {key: _spread(builder, builder.load(builder.gep(t, [_I64(where)]))) for key, where in TRIANGLE.items()}
    inverse = [_spread(builder, builder.load(builder.gep(t, [_I64(i)]))) for i in range(rows)]
    with _loop(builder, _I64(0), vectors, 1) as (k, _carried):
        start = builder.mul(k, _I64(LANES))
        places = [builder.gep(c, [builder.add(start, builder.mul(ld, _I64(i)))]) for i in range(rows)]
        solved: list[Any] = []
        for i, place in enumerate(places):
            value = _load(builder, place)
            for j in range(i):
                value = _multiply_add(builder, builder.fneg(entry[j, i]), solved[j], value)
            solved.append(builder.fmul(value, inverse[i]))
        for value, place in zip(solved, places, strict=True):
            _store(builder, value, place)


class _loop:  # noqa: N801  (reads as a keyword)
    """`for k in range(start, stop, step)` with values carried round; `final` holds them after the loop."""

    def __init__(self, builder: Any, start: Any, stop: Any, step: int, values: list[Any] | None = None) -> None:
        self.builder, self.start, self.stop, self.step, self.values = builder, start, stop, step, values or []

    def __enter__(self) -> tuple[Any, "_Carried"]:
        b = self.builder
        self.before = b.block
        self.head, self.body = b.append_basic_block("head"), b.append_basic_block("body")
        self.after = b.append_basic_block("after")
        b.branch(self.head)
        b.position_at_end(self.head)
        self.k = b.phi(_I64)
        self.k.add_incoming(self.start, self.before)
        self.phis = [b.phi(value.type) for value in self.values]
        for phi, value in zip(self.phis, self.values, strict=True):
            phi.add_incoming(value, self.before)
        b.cbranch(b.icmp_signed("<", self.k, self.stop), self.body, self.after)
        b.position_at_end(self.body)
        self.carried = _Carried(self.phis)
        return self.k, self.carried

    def __exit__(self, *_problem: Any) -> None:
        b = self.builder
        self.k.add_incoming(b.add(self.k, _I64(self.step)), b.block)
        for phi, value in zip(self.phis, self.carried, strict=True):
            phi.add_incoming(value, b.block)
        b.branch(self.head)
        b.position_at_end(self.after)
        self.carried.final = self.phis


class _Carried(list[Any]):
    final: list[Any]


def _switch(
    builder: Any, case: Any, name: str, shapes: dict[int, tuple[int, ...]], args: list[Any], build: Any
) -> None:
    """Call the variant of `name` that `case` selects."""
    kinds = [arg.type for arg in args]
    done = builder.append_basic_block("done")
    choice = builder.switch(case, done)
    for value, shape in shapes.items():
        block = builder.append_basic_block("case")
        choice.add_case(_I64(value), block)
        builder.position_at_end(block)
        full_name = f"{name}_{'x'.join(map(str, shape))}"
        builder.call(_define(builder, full_name, kinds, lambda b, *a, shape=shape: build(b, shape, *a)), args)
        builder.branch(done)
    builder.position_at_end(done)


def _define(builder: Any, name: str, kinds: list[Any], build: Any) -> Any:
    """The function `name` of this module, built on first use."""
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(ir.VoidType(), kinds), name)
    if not function.blocks:
        function.linkage = "linkonce_odr"
        function.attributes.add("noinline")  # inlined at each call they would only make compilation slow
        inner = ir.IRBuilder(function.append_basic_block("entry"))
        build(inner, *function.args)
        inner.ret_void()
    return function


def _address(context: Any, builder: Any, signature: Any, array: Any, index: Any, which: int = 0) -> Any:
    data = context.make_array(signature.args[which])(context, builder, array).data
    return builder.gep(data, [index])


def _load(builder: Any, pointer: Any, kind: Any = _VEC) -> Any:
    return builder.load(builder.bitcast(pointer, kind.as_pointer()), align=8)


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, value.type.as_pointer()), align=8)


def _load_one(builder: Any, pointer: Any) -> Any:
    return builder.load(pointer)


def _store_one(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, pointer)


def _spread(builder: Any, value: Any, kind: Any = _VEC) -> Any:
    """The value in every lane."""
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    lanes = ir.VectorType(ir.IntType(32), kind.count)
    return builder.shuffle_vector(first, first, ir.Constant(lanes, [0] * kind.count))


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a·b + c, fused where the processor can."""
    kind = ir.FunctionType(c.type, [c.type] * 3)
    fused = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{c.type.count}f64")
    return builder.call(fused, [a, b, c])
