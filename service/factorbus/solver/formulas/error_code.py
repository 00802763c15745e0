"""What the linear model of a factor of an own kind misses, in LLVM's language.  MATH (9.11), (9.31), §3.11.

Where the residual r and the Jacobian J of a formula are computed, so is how far both are from the model that is kept of
them, r₀ and J₀ where the factor was linearized and δ further, without a number of J being stored:

    missed = √w r − √w₀ (r₀ + J₀ δ)                     its square is missedᵀ Ω missed
    force = Σₖ (ΔJᵀ Ω √w r)ₖ² / (w Jᵀ Ω J)ₖₖ            ΔJ = √w J − √w₀ J₀, over the free scalars k

with w and w₀ the weights of its loss, which the caller knows.
"""

from collections.abc import Callable, Sequence
from typing import Any

from factorbus.solver.formulas.terms import DOUBLE, INTEGER, LANES, WIDE
from factorbus.solver.kernels.jit.compile import ir
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expressions import CHI2, FORCE, MISSED, ROOT, ROOT_WAS

_MAY = ("contract", "nsz")
_MOST_TANGENT = 9  # scalars of a variable
_UNROLLED = 15  # rows up to which sums with Ω are instructions, one behind the other; of 64 these take 3 s to compile


class ErrorCode:
    """The parts of it, each written where its builder is.

    was: r₀ (dim,), behind it J₀ (dim, scalars); information: the upper triangle of Ω; delta: δ of all scalars; out: r
    (dim,), and behind it what `expressions` names
    """

    def __init__(
        self, entry: Any, sizes: Sequence[int], dim: int, was: Any, information: Any, delta: Any, out: Any
    ) -> None:
        """sizes: scalars of each variable"""
        self._sizes, self._dim, self._scalars = sizes, dim, sum(sizes)
        self._was, self._information, self._delta, self._out = was, information, delta, out
        self._blocks = -(-self._scalars // LANES)
        self._pulls = entry.alloca(DOUBLE, dim)  # Ω r
        self._moved = entry.alloca(WIDE, dim)  # of J₀ δ, lane by lane
        self._force = entry.alloca(WIDE)
        self._shift, self._free = (entry.alloca(WIDE, self._blocks) for _ in range(2))
        if dim > _UNROLLED:
            self._of, self._product = (entry.alloca(DOUBLE, dim) for _ in range(2))
            self._slopes, self._diagonals = entry.alloca(WIDE, dim), entry.alloca(WIDE)

    def begin(self, builder: Any, var: Any, rows: Sequence[Any], residual: Sequence[Any]) -> None:
        """δ and which scalars are free, χ² and Ω r.  rows: where each variable's row of `var` begins"""
        kind = ir.ArrayType(DOUBLE, _MOST_TANGENT)
        zeros: Any = ir.GlobalVariable(builder.module, kind, "zeros")
        zeros.global_constant, zeros.linkage, zeros.initializer = True, "internal", kind([0.0] * _MOST_TANGENT)
        shift, free = (builder.bitcast(array, DOUBLE.as_pointer()) for array in (self._shift, self._free))
        c = 0
        for row, size in zip(rows, self._sizes, strict=True):
            scalar = builder.load(builder.gep(var, [builder.add(row, INTEGER(at.V_SCALAR))]))
            is_free = builder.icmp_signed(">=", scalar, INTEGER(0))
            none = builder.gep(zeros, [INTEGER(0), INTEGER(0)])
            here = builder.select(is_free, builder.gep(self._delta, [scalar]), none)
            one = builder.uitofp(is_free, DOUBLE)
            for k in range(size):
                self._store(builder, shift, c + k, builder.load(builder.gep(here, [INTEGER(k)])))
                self._store(builder, free, c + k, one)
            c += size
        for k in range(c, self._blocks * LANES):
            self._store(builder, shift, k, DOUBLE(0.0))
            self._store(builder, free, k, DOUBLE(0.0))
        pulls = self._times_information(builder, residual)
        for a, pull in enumerate(pulls):
            self._store(builder, self._pulls, a, pull)
            builder.store(ir.Constant(WIDE, [0.0] * LANES), builder.gep(self._moved, [INTEGER(a)]))
        self._store(builder, self._out, self._dim + CHI2, self._inner(builder, pulls, residual))
        builder.store(ir.Constant(WIDE, [0.0] * LANES), self._force)

    def add(self, builder: Any, block: Any, slopes: Sequence[Any]) -> None:
        """The shares of a block of scalars, of which J is `slopes`."""
        root, root_was = (self._spread(builder, self._kept(builder, k)) for k in (ROOT, ROOT_WAS))
        shift, free = (builder.load(builder.gep(array, [block])) for array in (self._shift, self._free))
        column, zero = builder.mul(block, INTEGER(LANES)), ir.Constant(WIDE, [0.0] * LANES)
        turned: Any = zero
        for a, slope in enumerate(slopes):
            place = builder.add(column, INTEGER(self._dim + a * self._scalars))
            here = builder.bitcast(builder.gep(self._was, [place]), WIDE.as_pointer())
            linear = self._within(builder, block, builder.load(here, align=8))
            sum_at = builder.gep(self._moved, [INTEGER(a)])
            builder.store(self._plus(builder, builder.load(sum_at), linear, shift), sum_at)
            differs = builder.fsub(builder.fmul(root, slope), builder.fmul(root_was, linear), flags=_MAY)
            pull = builder.load(builder.gep(self._pulls, [INTEGER(a)]))
            turned = self._plus(builder, turned, differs, self._spread(builder, pull))
        turned, diagonal = builder.fmul(root, turned), self._diagonal(builder, slopes)
        diagonal = builder.fmul(builder.fmul(root, root), builder.fadd(diagonal, diagonal))
        share = builder.fdiv(builder.fmul(builder.fmul(turned, turned), free), diagonal)
        # Nothing where its loss has set the factor aside.
        share = builder.select(builder.fcmp_ordered(">", diagonal, zero), share, zero)
        builder.store(builder.fadd(builder.load(self._force), share), self._force)

    def end(self, builder: Any, residual: Sequence[Any], has_slopes: Any) -> None:
        """The squares of what is missed and of the force."""
        root, root_was = self._kept(builder, ROOT), self._kept(builder, ROOT_WAS)
        missed = []
        for a, number in enumerate(residual):
            moved = self._sum(builder, builder.load(builder.gep(self._moved, [INTEGER(a)])))
            linear = builder.fadd(builder.load(builder.gep(self._was, [INTEGER(a)])), moved)
            missed.append(builder.fsub(builder.fmul(root, number), builder.fmul(root_was, linear), flags=_MAY))
        force = builder.select(has_slopes, self._sum(builder, builder.load(self._force)), DOUBLE(0.0))
        self._store(builder, self._out, self._dim + MISSED, self.square(builder, missed))
        self._store(builder, self._out, self._dim + FORCE, force)

    def square(self, builder: Any, numbers: Sequence[Any]) -> Any:
        """Their square with Ω."""
        return self._inner(builder, self._times_information(builder, numbers), numbers)

    def _inner(self, builder: Any, a: Sequence[Any], b: Sequence[Any]) -> Any:
        total: Any = DOUBLE(0.0)
        for x, y in zip(a, b, strict=True):
            total = self._plus(builder, total, x, y)
        return total

    def _times_information(self, builder: Any, numbers: Sequence[Any]) -> list[Any]:
        """Ω times them."""
        if self._dim > _UNROLLED:
            return self._times_information_in_loops(builder, numbers)
        out: list[Any] = [DOUBLE(0.0)] * self._dim
        k = 0
        for a in range(self._dim):
            for b in range(a, self._dim):
                weight = self._entry(builder, INTEGER(k))
                out[a] = self._plus(builder, out[a], weight, numbers[b])
                if b > a:
                    out[b] = self._plus(builder, out[b], weight, numbers[a])
                k += 1
        return out

    def _times_information_in_loops(self, builder: Any, numbers: Sequence[Any]) -> list[Any]:
        of, out = self._of, self._product
        for a, number in enumerate(numbers):
            self._store(builder, of, a, number)

        def begun(a: Any) -> None:
            own = builder.fmul(self._entry(builder, self._place(builder, a, a)), builder.load(builder.gep(of, [a])))
            builder.store(own, builder.gep(out, [a]))

        def joined(a: Any, b: Any) -> None:
            weight = self._entry(builder, self._place(builder, a, b))
            for x, y in ((a, b), (b, a)):
                to = builder.gep(out, [x])
                builder.store(self._plus(builder, builder.load(to), weight, builder.load(builder.gep(of, [y]))), to)

        _loop(builder, INTEGER(0), self._dim, begun)
        self._pairs(builder, joined)
        return [builder.load(builder.gep(out, [INTEGER(a)])) for a in range(self._dim)]

    def _diagonal(self, builder: Any, slopes: Sequence[Any]) -> Any:
        """Half the diagonal of Jᵀ Ω J."""
        half = self._spread(builder, DOUBLE(0.5))
        if self._dim > _UNROLLED:
            return self._diagonal_in_loops(builder, slopes, half)
        diagonal: Any = ir.Constant(WIDE, [0.0] * LANES)
        k = 0
        for a, slope in enumerate(slopes):
            row = builder.fmul(self._spread(builder, self._entry(builder, INTEGER(k))), builder.fmul(half, slope))
            for b in range(a + 1, self._dim):
                weight = self._spread(builder, self._entry(builder, INTEGER(k + b - a)))
                row = self._plus(builder, row, weight, slopes[b])
            diagonal, k = self._plus(builder, diagonal, row, slope), k + self._dim - a
        return diagonal

    def _diagonal_in_loops(self, builder: Any, slopes: Sequence[Any], half: Any) -> Any:
        of, out = self._slopes, self._diagonals
        for a, slope in enumerate(slopes):
            self._store(builder, of, a, slope)
        builder.store(ir.Constant(WIDE, [0.0] * LANES), out)

        def share(a: Any, b: Any, times: Any) -> None:
            weight = self._spread(builder, self._entry(builder, self._place(builder, a, b)))
            x, y = (builder.load(builder.gep(of, [k])) for k in (a, b))
            both = builder.fmul(weight, builder.fmul(x, y))
            builder.store(self._plus(builder, builder.load(out), both, times), out)

        one = self._spread(builder, DOUBLE(1.0))
        _loop(builder, INTEGER(0), self._dim, lambda a: share(a, a, half))
        self._pairs(builder, lambda a, b: share(a, b, one))
        return builder.load(out)

    def _pairs(self, builder: Any, body: Callable[[Any, Any], None]) -> None:
        """For a < b."""

        def row(a: Any) -> None:
            _loop(builder, builder.add(a, INTEGER(1)), self._dim, lambda b: body(a, b))

        _loop(builder, INTEGER(0), self._dim - 1, row)

    def _place(self, builder: Any, a: Any, b: Any) -> Any:
        """Of Ω(a, b) in the upper triangle: a (2 dim − 1 − a) / 2 + b."""
        twice = builder.mul(a, builder.sub(INTEGER(2 * self._dim - 1), a))
        return builder.add(builder.lshr(twice, INTEGER(1)), b)

    def _within(self, builder: Any, block: Any, value: Any) -> Any:
        """0 in the lanes behind the last scalar."""
        if self._scalars % LANES == 0:
            return value
        bits = ir.VectorType(ir.IntType(1), LANES)
        some = ir.Constant(bits, [int(lane < self._scalars % LANES) for lane in range(LANES)])
        is_last = builder.icmp_signed("==", block, INTEGER(self._blocks - 1))
        return builder.select(
            builder.select(is_last, some, ir.Constant(bits, [1] * LANES)), value, ir.Constant(WIDE, [0.0] * LANES)
        )

    def _entry(self, builder: Any, k: Any) -> Any:
        return builder.load(builder.gep(self._information, [k]))

    def _kept(self, builder: Any, k: int) -> Any:
        return builder.load(builder.gep(self._out, [INTEGER(self._dim + k)]))

    @staticmethod
    def _store(builder: Any, array: Any, k: int, value: Any) -> None:
        builder.store(value, builder.gep(array, [INTEGER(k)]))

    @staticmethod
    def _plus(builder: Any, total: Any, a: Any, b: Any) -> Any:
        return builder.fadd(total, builder.fmul(a, b, flags=_MAY), flags=_MAY)

    @staticmethod
    def _spread(builder: Any, number: Any) -> Any:
        one = builder.insert_element(ir.Constant(WIDE, ir.Undefined), number, ir.IntType(32)(0))
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return builder.shuffle_vector(one, ir.Constant(WIDE, ir.Undefined), lanes)

    @staticmethod
    def _sum(builder: Any, value: Any) -> Any:
        """Of all lanes, halves added up."""
        lanes = LANES
        while lanes > 1:
            half = ir.Constant(
                ir.VectorType(ir.IntType(32), LANES),
                [lane + lanes // 2 if lane < lanes // 2 else lane for lane in range(LANES)],
            )
            value = builder.fadd(value, builder.shuffle_vector(value, ir.Constant(WIDE, ir.Undefined), half))
            lanes //= 2
        return builder.extract_element(value, ir.IntType(32)(0))


def _loop(builder: Any, first: Any, end: int, body: Callable[[Any], None]) -> None:
    """For k from `first`, which is below `end`; what follows goes behind it."""
    before, head = builder.block, builder.append_basic_block()
    builder.branch(head)
    builder.position_at_end(head)
    k = builder.phi(INTEGER)
    k.add_incoming(first, before)
    body(k)
    following = builder.add(k, INTEGER(1))
    k.add_incoming(following, builder.block)
    after = builder.append_basic_block()
    builder.cbranch(builder.icmp_signed("<", following, INTEGER(end)), head, after)
    builder.position_at_end(after)
