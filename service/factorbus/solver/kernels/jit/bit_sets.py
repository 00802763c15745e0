"""Sets of fewer than 64 things as the bits of a word."""

from typing import Any

from factorbus.solver.kernels.jit.compile import DISABLED, intrinsic, ir, types

MOST = 63  # the sign is left out: a word is never negative

count_bits: Any
lowest_bit: Any
highest_bit: Any

if DISABLED:

    def _count(word: int) -> int:
        """How many there are in the set."""
        return int(word).bit_count()

    def _lowest(word: int) -> int:
        """The first of them; there has to be one."""
        return (int(word) & -int(word)).bit_length() - 1

    def _highest(word: int) -> int:
        """The last of them."""
        return int(word).bit_length() - 1

    count_bits, lowest_bit, highest_bit = _count, _lowest, _highest

else:

    @intrinsic
    def _compiled_count(_typing: Any, word: Any) -> Any:
        """How many there are in the set."""

        def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return builder.ctpop(args[0])

        return types.int64(word), emit

    @intrinsic
    def _compiled_lowest(_typing: Any, word: Any) -> Any:
        """The first of them; there has to be one."""

        def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

        return types.int64(word), emit

    @intrinsic
    def _compiled_highest(_typing: Any, word: Any) -> Any:
        """The last of them."""

        def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return builder.sub(args[0].type(MOST), builder.ctlz(args[0], ir.Constant(ir.IntType(1), 1)))

        return types.int64(word), emit

    count_bits, lowest_bit, highest_bit = _compiled_count, _compiled_lowest, _compiled_highest
