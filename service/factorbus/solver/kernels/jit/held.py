"""What of a function need not be written for LLVM: places in memory of what is a value, and values that nobody uses.

Numba holds as values what is used only in the block that assigns it, and writes all other variables to memory, which it
clears first.  To find out that they are values as well is most of what LLVM does with a part.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from llvmlite import ir as llvm
from llvmlite.ir import instructions as code
from numba.core import ir
from numba.core.analysis import compute_cfg_from_blocks, compute_use_defs

__all__ = ["FoldingBuilder", "drop_unused", "find_held"]

# What only gives a value.
_PURE = {
    "add",
    "bitcast",
    "extractvalue",
    "getelementptr",
    "icmp",
    "insertvalue",
    "load",
    "mul",
    "select",
    "sub",
    "xor",
}


class FoldingBuilder(llvm.IRBuilder):
    """Writes no instruction to take out of a record or an array what was put into it in the same function."""

    def extract_value(self, agg: Any, idx: Any, name: str = "") -> Any:
        """What is at this place; a number, or the numbers of the way to it."""
        path = tuple(idx) if isinstance(idx, tuple | list) else (idx,)
        while isinstance(agg, code.InsertValue):
            place = tuple(agg.indices)
            if path[: len(place)] == place:
                rest = path[len(place) :]
                return self.extract_value(agg.value, rest, name) if rest else agg.value
            if place[: len(path)] == path:
                break  # a part of what is asked for
            agg = agg.aggregate
        return super().extract_value(agg, path, name)


def find_held(blocks: Mapping[int, Any]) -> set[str]:
    """The names of variables that are assigned once, before whatever uses them.

    Blocks are written in the order of their numbers, so the one that assigns is to be before those that use.
    """
    assigned: Counter[str] = Counter()
    where: dict[str, int] = {}
    for number, block in blocks.items():
        for statement in block.find_insts(ir.Assign):
            assigned[statement.target.name] += 1
            where[statement.target.name] = number
    held = {name for name, count in assigned.items() if count == 1}
    before = compute_cfg_from_blocks(blocks).dominators()
    for number, used in compute_use_defs(blocks).usemap.items():
        held -= {name for name in used & held if where[name] >= number or where[name] not in before[number]}
    return held


def drop_unused(function: Any) -> None:
    """Take out of the code of a function what gives a value that nothing uses."""
    used: Counter[int] = Counter()
    for block in function.blocks:
        for one in block.instructions:
            used.update(map(id, _operands(one)))
    for block in reversed(function.blocks):
        kept = []
        for one in reversed(block.instructions):
            if used[id(one)] or one.opname not in _PURE:
                kept.append(one)
            else:
                used.subtract(map(id, _operands(one)))
        block.instructions[:] = reversed(kept)


def _operands(one: Any) -> list[Any]:
    return [value for value, _ in one.incomings] if isinstance(one, code.PhiInstr) else one.operands
