"""Which id each key has in a file, so that reading the file gives the same key.

"ids"      x12 → 12 and l7 → 7: what reading gives the letters back to.  Needs poses x and points l, all numbered apart.
"apart"    the same where a pose and a point share a number, as GTSAM writes it; g2o's own programs cannot read that.
"keys"     the key itself, a letter in the top byte as GTSAM packs its symbols; g2o's own programs want less than 2³¹.
           Where no key has a letter, reading gives poses x and points l: a note says so.
"counted"  0, 1, 2, ... in the order of the graph: every program reads that, and the keys are lost.
"auto"     "ids" where it can be, else "keys".
"""

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.left_out import LeftOut
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import MAX_INDEX, symbol_parts

IDS = ("auto", "ids", "apart", "keys", "counted")
_POSES = ("se2", "se3")


def numbered(batch: Batch, ids: str, left: LeftOut) -> tuple[I64, I64]:
    """(keys, sorted, and the id of each).  Raises FormatError for a way that there is not, or that cannot be."""
    if ids not in IDS:
        raise FormatError("g2o", None, f"ids {ids!r}", f"one of {', '.join(IDS)}")
    keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables)])
    order = np.argsort(keys, kind="stable")
    if ids == "counted":
        return keys[order], np.arange(len(keys))[order]
    numbers, are_usual = _numbers(batch)
    shared = len(np.unique(numbers)) < len(numbers)
    if ids == "auto":
        ids = "ids" if are_usual and not shared else "keys"
    if ids == "apart" and not (shared and are_usual and _is_apart(batch, numbers)):
        ids = "ids" if are_usual and not shared else "keys"
    if ids == "ids" and not (are_usual and not shared):
        raise FormatError("g2o", None, "keys that their numbers do not tell apart", 'ids "auto", "keys" or "counted"')
    if ids == "keys":
        if (keys > MAX_INDEX).any():
            left.say(
                "ids are keys as GTSAM packs its symbols: reading gives the same keys; g2o's own programs want smaller "
                'ones, which "counted" gives'
            )
        elif len(keys):
            left.say("no key has a letter, and a file of such ids says none: reading gives poses x and points l")
        return _as_keys(keys[order])
    return keys[order], numbers[order]


def _as_keys(keys: I64) -> tuple[I64, I64]:
    if (keys < 0).any():
        raise FormatError("g2o", None, f"the key {keys[0]}, below 0", 'keys of 0 and more, or ids "counted"')
    return keys, keys


def _numbers(batch: Batch) -> tuple[I64, bool]:
    """(the number of each key in the order of the batch, whether all have the letters that reading gives them)."""
    numbers, usual = [np.empty(0, np.int64)], True
    for group in batch.variables:
        parts = [symbol_parts(key) for key in group.keys.tolist()]
        usual &= all(letter == ("x" if group.kind in _POSES else "l") for letter, _ in parts)
        numbers.append(np.array([number for _, number in parts], np.int64))
    return np.concatenate(numbers), usual


def _is_apart(batch: Batch, numbers: I64) -> bool:
    """Whether reading notices that poses and points are numbered separately: an id with a vertex line of each."""
    seen: dict[bool, list[I64]] = {True: [], False: []}
    first = 0
    for group in batch.variables:
        if group.values is not None:
            seen[group.kind in _POSES].append(numbers[first : first + len(group.keys)])
        first += len(group.keys)
    empty = np.empty(0, np.int64)
    poses, points = (np.concatenate([empty, *seen[is_pose]]) for is_pose in (True, False))
    return bool(np.isin(poses, points).any())
