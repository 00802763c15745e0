"""Words that several threads change, and how one waits for another.

`exchange` and `fetch_add` are in order with all that is read and written before and behind them, on every thread.  To
sleep and to wake is for Linux alone: elsewhere there are no worker threads.
"""

import sys
from typing import Any

from factorbus.solver.kernels.jit.array_table import address_of
from factorbus.solver.kernels.jit.compile import DISABLED, I64, inline_kernel, intrinsic, types

CAN_SLEEP = sys.platform == "linux" and not DISABLED
SEMAPHORE = 4  # words of a POSIX one

exchange: Any
fetch_add: Any

if DISABLED:

    def _exchange(words: I64, i: int, x: int) -> int:
        """words[i] = x; gives what it was."""
        was = int(words[i])
        words[i] = x
        return was

    def _fetch_add(words: I64, i: int, x: int) -> int:
        """words[i] += x; gives what it was."""
        return _exchange(words, i, int(words[i]) + x)

    exchange, fetch_add = _exchange, _fetch_add

else:

    def _atomic(operation: str) -> Any:
        @intrinsic
        def changed(_typing: Any, words: Any, _i: Any, _x: Any) -> Any:
            """What words[i] was before."""

            def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
                data = context.make_array(signature.args[0])(context, builder, args[0]).data
                return builder.atomic_rmw(operation, builder.gep(data, [args[1]]), args[2], "seq_cst")

            return types.int64(words, types.int64, types.int64), emit

        return changed

    exchange, fetch_add = _atomic("xchg"), _atomic("add")

if CAN_SLEEP:
    _wait = types.ExternalFunction("sem_wait", types.int32(types.intp))
    _post = types.ExternalFunction("sem_post", types.int32(types.intp))
    _yield = types.ExternalFunction("sched_yield", types.int32())

    @inline_kernel
    def sleep(words: I64, i: int) -> None:
        """Until another thread wakes those that sleep at the semaphore in words[i :]; a signal does it too."""
        _wait(address_of(words) + 8 * i)

    @inline_kernel
    def wake(words: I64, i: int) -> None:
        """One of those who sleep there, or the next one who would."""
        _post(address_of(words) + 8 * i)

    @inline_kernel
    def give_way() -> None:
        """To another thread that waits for this core."""
        _yield()

else:

    @inline_kernel
    def sleep(words: I64, i: int) -> None:
        """See above; likewise below."""

    @inline_kernel
    def wake(words: I64, i: int) -> None:
        pass

    @inline_kernel
    def give_way() -> None:
        pass
