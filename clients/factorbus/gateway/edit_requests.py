"""What a body says is to be done: which edits there are, which fields each has, and what they may be.

| edit | fields | |
|---|---|---|
| reject | factors | factors go, and can be restored |
| restore | factors | those that were rejected come back |
| accept_closures, reject_closures | factors | of a map that tests them: they are in for good, or out |
| weigh | factors, weight | their information is multiplied by it |
| fix, free | keys | variables are held, and estimated again |
| prior | key, value, sigmas | a variable is where one has dragged it to, give or take |
| anchor | key, place, sigma | the same of its place alone, metres |
| merge | other, pairs, sigmas, absolute | another map into this one: `merge_plans` |
| undo | number | the last edit, which is named so that nobody undoes another's unseen |
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from factorbus.client.merging import ABSOLUTE
from factorbus.proto.keys import is_name
from factorbus.proto.nearest import nearest
from factorbus.proto.problems import BadMessage, BadOption
from factorbus.proto.symbols import parse_symbol

_MOST = 10_000  # factors, keys or pairs of one edit
_MOST_ID = (1 << 53) - 1


class EditRequest(NamedTuple):
    """One edit: its name, and its fields as they have been checked; keys are numbers."""

    edit: str
    fields: Mapping[str, Any]


def read_edit(content: Any) -> EditRequest:
    """The edit that `content`, from JSON, is.  Raises BadMessage, BadOption, BadSymbol."""
    if not isinstance(content, dict):
        wanted = 'an object, such as {"edit": "reject", "factors": [17]}'
        raise BadMessage("the body", f"{type(content).__name__}", wanted)
    edit = content.get("edit")
    if not isinstance(edit, str) or edit not in _FIELDS:
        raise BadOption("edit", f"{edit!r:.60}", f"one of {', '.join(_FIELDS)}{nearest(str(edit)[:64], _FIELDS)}")
    wanted, given = _FIELDS[edit], {name: each for name, each in content.items() if name != "edit"}
    for name in given:
        if name not in wanted:
            raise BadOption(edit, f"there is no field {name[:64]!r}", ", ".join(wanted))
    usual = {name: _USUAL[name] for name in wanted if name in _USUAL}
    given = usual | given
    for name in wanted:
        if name not in given:
            raise BadOption(edit, f"it has no field {name!r}", ", ".join(wanted))
    return EditRequest(edit, {name: read(f"{edit}: {name}", given[name]) for name, read in wanted.items()})


def _ids(where: str, given: Any) -> list[int]:
    return list(dict.fromkeys(_id(where, each) for each in _listed(where, given, "ids of factors")))


def _id(where: str, given: Any) -> int:
    if type(given) is not int or not 0 <= given <= _MOST_ID:
        raise BadOption(where, f"{given!r:.60}", "a whole number, 0 or more")
    return given


def _some_keys(where: str, given: Any) -> list[int]:
    return list(dict.fromkeys(_key(where, each) for each in _listed(where, given, "keys")))


def _key(where: str, given: Any) -> int:
    if not isinstance(given, str):
        raise BadOption(where, f"{given!r:.60}", "a key as it prints, such as x12")
    return parse_symbol(given)


def _pairs(where: str, given: Any) -> list[tuple[int, int]]:
    pairs = []
    for each in _listed(where, given, "pairs of keys"):
        if not isinstance(each, list) or len(each) != 2:
            raise BadOption(where, f"{each!r:.60}", 'the key of a pose here and of one in the other map: ["x5", "x8"]')
        pairs.append((_key(where, each[0]), _key(where, each[1])))
    return pairs


def _listed(where: str, given: Any, what: str) -> list[Any]:
    if not isinstance(given, list) or not 0 < len(given) <= _MOST:
        raise BadOption(where, f"{given!r:.60}", f"a list of {what}, 1 to {_MOST}")
    return given


def _numbers(where: str, given: Any) -> list[float]:
    return [_number(where, each) for each in _listed(where, given, "numbers")]


def _positive_numbers(where: str, given: Any) -> list[float]:
    return [_positive(where, each) for each in _listed(where, given, "numbers")]


def _number(where: str, given: Any) -> float:
    """JSON's own numbers may be as long as they like."""
    try:
        number = math.nan if isinstance(given, bool) or not isinstance(given, int | float) else float(given)
    except OverflowError:
        number = math.nan
    if not math.isfinite(number):
        raise BadOption(where, f"{given!r:.60}", "a finite number")
    return number


def _positive(where: str, given: Any) -> float:
    number = _number(where, given)
    if not 1e-9 <= number <= 1e9:
        raise BadOption(where, f"{number!r}", "a number from 1e-9 to 1e9")
    return number


def _name(where: str, given: Any) -> str:
    if not is_name(given):
        raise BadOption(where, f"{given!r:.60}", "the name of a map")
    return given


def _absolute(where: str, given: Any) -> str:
    if given not in ABSOLUTE:
        raise BadOption(where, f"{given!r:.60}", f"one of {', '.join(ABSOLUTE)}")
    return given


_USUAL: Mapping[str, Any] = {"absolute": "refuse"}
_FIELDS: Mapping[str, Mapping[str, Callable[[str, Any], Any]]] = {
    "reject": {"factors": _ids},
    "restore": {"factors": _ids},
    "accept_closures": {"factors": _ids},
    "reject_closures": {"factors": _ids},
    "weigh": {"factors": _ids, "weight": _positive},
    "fix": {"keys": _some_keys},
    "free": {"keys": _some_keys},
    "prior": {"key": _key, "value": _numbers, "sigmas": _positive_numbers},
    "anchor": {"key": _key, "place": _numbers, "sigma": _positive},
    "merge": {"other": _name, "pairs": _pairs, "sigmas": _positive_numbers, "absolute": _absolute},
    "undo": {"number": _id},
}
