"""A part of a map, by the letters of its keys, apart from the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorbus.client.arguments import of_type
from factorbus.client.merging import CannotMerge
from factorbus.proto.arrays import I64
from factorbus.proto.kinds import name_of_kind
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.roles import keys_in_no_frame, pick_factors, pick_variables
from factorbus.proto.symbols import format_symbol, symbol

_SHOWN = 3
_NONE = np.empty(0, np.int64)
_JOINED = (
    "the part is joined to the rest already, by {}; wanted a part that has no factor with the rest: keep candidates "
    "out of the map, and give them to `attach`"
)


def split_by_letters(graph: Batch, letters: str, joined: str = _JOINED) -> tuple[Batch, tuple[Variables, ...]]:
    """The part whose keys have these letters, and the variables of the rest.

    joined: what is said where a factor is between them, which `{}` names.
    Raises CannotMerge (no part, no rest, a factor between them), BadSymbol, BadOption.
    """
    codes = _codes(letters)
    names = np.concatenate([_NONE, *(group.keys for group in graph.variables)])
    _check_there(codes, names)
    aside, factors = keys_in_no_frame(graph), list[Factors]()
    for group in graph.factors:
        of_part, nowhere = np.isin(group.keys >> 56, codes), np.isin(group.keys, aside)
        some = np.asarray((of_part & ~nowhere).any(axis=1))
        both = some & np.asarray((~of_part & ~nowhere).any(axis=1))
        if both.any():
            raise CannotMerge(joined.format(f"{name_of_kind(group.kind)} {pairs_named(group.keys[both])}"))
        if some.any():
            factors.append(pick_factors(group, some))
    groups = [(group, np.isin(group.keys >> 56, codes)) for group in graph.variables]
    part = tuple(pick_variables(group, chosen) for group, chosen in groups if chosen.any())
    rest = tuple(pick_variables(group, ~chosen) for group, chosen in groups if not chosen.all())
    return Batch(part, tuple(factors)), rest


def adrift(keys: I64, factors: Sequence[Factors], held: I64) -> I64:
    """The variables among `keys` that no chain of factors joins to one that is `held`."""
    root = {key: key for key in keys.tolist()}

    def find(key: int) -> int:
        while root[key] != key:
            root[key] = root[root[key]]
            key = root[key]
        return key

    for group in factors:
        for row in group.keys.tolist():
            first, *others = [key for key in row if key in root] or [None]
            for other in others:
                root[find(other)] = find(first)
    reached = {find(key) for key in held.tolist() if key in root}
    return np.array([key for key in root if find(key) not in reached], np.int64)


def pairs_named(pairs: I64) -> str:
    """The keys of the first of some factors, and how many more there are."""
    more = f" and {len(pairs) - _SHOWN} more" if len(pairs) > _SHOWN else ""
    return ", ".join(f"({', '.join(map(format_symbol, keys))})" for keys in pairs[:_SHOWN].tolist()) + more


def _codes(letters: str) -> list[int]:
    """Raises CannotMerge, BadSymbol, BadOption."""
    if not of_type("letters", letters, str, 'letters, such as "b"'):
        raise CannotMerge('letters is empty; wanted those of the part that is to be attached, such as "b"')
    return sorted({symbol(letter, 0) >> 56 for letter in letters})


def _check_there(codes: list[int], names: I64) -> None:
    """A letter that no variable has would be a slip that goes by unseen.  Raises CannotMerge."""
    have = sorted(set((names >> 56).tolist()))
    listed = ", ".join(chr(code) if chr(code).isalpha() else "none (keys that are a number)" for code in have)
    if missing := [chr(code) for code in codes if code not in have]:
        raise CannotMerge(
            f"the map has no variable with letter {', '.join(missing)}; wanted letters of the part that is to be "
            f"attached, of those there are: {listed or 'the map is empty'}"
        )
    if len(codes) == len(have):
        raise CannotMerge(
            f"the map has no variable with other letters than {listed}; wanted the letters of a part, which is brought "
            "into the frame of the rest"
        )
