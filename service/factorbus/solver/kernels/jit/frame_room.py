"""Room for the frames of Python's calls, for what calls as deeply as a compiler.

CPython keeps the frames of a thread in chunks of 16 KiB.  A call that does not fit maps a new one, and its return
unmaps it: who goes up and down across the end of a chunk has it mapped, cleared and unmapped at every turn.  Numba's
calls did that 600,000 times while all kernels were compiled, an eighth of the time.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any

__all__ = ["call_with_room"]

_WORDS = 1 << 17  # 1 MiB, more than half of a chunk of 2 MiB, so that one of these is mapped; nothing touches it


def _call(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


def call_with_room(function: Callable[..., Any], *arguments: Any) -> Any:
    """What `function(*arguments)` gives, called from a frame behind which its chunk has almost 1 MiB for others."""
    return _with_room(function, *arguments)


_with_room = FunctionType(_call.__code__.replace(co_stacksize=_WORDS), globals())
