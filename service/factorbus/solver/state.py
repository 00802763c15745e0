"""The state of a solver as plain values, to go on from in another process, to the bit.

Every attribute of the objects that a solver is made of belongs to its state, but those that the class names in
`NOT_KEPT`: what the constructor is given, and scratch memory that is made when it is needed.  So a new attribute is
kept unless somebody says otherwise, and one that cannot be written is an error when the state is taken.

Of an array with room behind what is in use, only that much is kept: the class tells of it in `in_use`.

A state is a dict of arrays, numbers, text, None, lists, and dicts like it.  Which, and what their numbers mean, is its
`FORMAT`: what keeps a state keeps that beside it, and gives a solver only one in its own.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, TypeAlias

import numpy as np

from factorbus.solver.graph.arenas import lines

State: TypeAlias = dict[str, Any]

# One more whenever a state of before cannot be gone on from: a part, its type, the width of a row, the place or the
# meaning of a number has changed (`kernels/model/layout.py`, `kernels/bayes_tree/layout.py`).
# tests/service/test_state_format.py notices all of these but meanings, and says how to note the new one.
FORMAT = 20

_PLAIN = (bool, int, float, str, type(None))
_TYPE = "type"


def dump(thing: Any) -> State:
    """The state of `thing`, a copy.  Raises TypeError for an attribute that no state can hold."""
    used = thing.in_use() if hasattr(thing, "in_use") else {}
    return {
        name: _dumped(value[used[name]] if name in used else value, f"{type(thing).__name__}.{name}")
        for name, value in _kept(thing)
    }


def load(thing: Any, state: Mapping[str, Any], types: Mapping[str, type]) -> None:
    """Give `thing`, made with the same settings as the one that was dumped, the state `state`.

    types: the value types that occur in it, by name.  Raises ValueError when `state` is of something else.
    """
    names = [name for name, _ in _kept(thing)]
    if set(names) != set(state):
        odd = sorted(set(names) ^ set(state))
        raise ValueError(f"this is no state of {type(thing).__name__}: {', '.join(odd)} are in one of them only")
    for name in names:
        present = getattr(thing, name)
        _check_alike(f"{type(thing).__name__}.{name}", present, state[name])
        if _is_part(present) and isinstance(state[name], dict):
            load(present, state[name], types)
        else:
            setattr(thing, name, _loaded(state[name], types))


def _check_alike(where: str, present: Any, value: Any) -> None:
    """Raises ValueError for an array of other numbers, or of more or fewer dimensions, than kernels work on there."""
    if isinstance(present, np.ndarray):
        here, there = _form(present), _form(value)
        if here != there:
            raise ValueError(f"this is no state of a solver here: {where} is {there}, wanted {here}")


def _form(value: Any) -> str:
    return f"{value.dtype} in {value.ndim} dimensions" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"


def aligned_copy(array: np.ndarray) -> np.ndarray:
    """A copy that starts at a cache line, with a line behind it that may be read: kernels want both of some arrays."""
    made = lines(array.shape, array.dtype)
    made[...] = array
    return made


def _kept(thing: Any) -> list[tuple[str, Any]]:
    left_out = getattr(type(thing), "NOT_KEPT", ())
    return [(name, value) for name, value in vars(thing).items() if name not in left_out]


def _is_part(value: Any) -> bool:
    """An object of the solver that has a state of its own."""
    own = type(value).__module__.startswith("factorbus.solver")
    return own and hasattr(value, "__dict__") and not isinstance(value, Enum) and not is_dataclass(value)


def _dumped(value: Any, where: str) -> Any:
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return [_dumped(item, where) for item in value]
    if isinstance(value, Enum):
        return {_TYPE: type(value).__name__, "name": value.name}
    if is_dataclass(value):
        content = {f.name: _dumped(getattr(value, f.name), f"{where}.{f.name}") for f in fields(value)}
        return {_TYPE: type(value).__name__} | content
    if _is_part(value):
        return dump(value)
    raise TypeError(f"{where} is a {type(value).__name__}, which no state can hold: add it to NOT_KEPT of its class")


def _loaded(value: Any, types: Mapping[str, type]) -> Any:
    if isinstance(value, np.ndarray):
        return aligned_copy(value)
    if isinstance(value, list):
        return tuple(_loaded(item, types) for item in value)
    if isinstance(value, dict):
        kind: Any = types.get(str(value.get(_TYPE)))
        if kind is None:
            raise ValueError(f"{value.get(_TYPE)!r} is no type in a solver's state; wanted one of {', '.join(types)}")
        if issubclass(kind, Enum):
            return kind[value["name"]]
        return kind(**{field: _loaded(item, types) for field, item in value.items() if field != _TYPE})
    return value
