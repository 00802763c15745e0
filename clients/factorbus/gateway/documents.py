"""Messages of the bus as JSON documents: keys as they print, values row by row."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from starlette.responses import JSONResponse

from factorbus.client import Snapshot
from factorbus.proto.messages import Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol

_EXACT = (1 << 53) - 1  # up to here JavaScript has every whole number
_KEYS = ("key", "keys")  # fields of a problem's detail that name variables


class Document(JSONResponse):
    """An answer as JSON, which has no word for what is not a finite number: null."""

    def render(self, content: Any) -> bytes:
        try:
            return super().render(content)
        except ValueError:
            return super().render(_finite(content))


def _finite(content: Any) -> Any:
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, dict):
        return {str(name): _finite(value) for name, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    return content


def problem(code: str, message: str, detail: Any) -> dict[str, Any]:
    """A problem: keys as they print, and other whole numbers that JavaScript would round as text."""
    return {"problem": {"code": code, "message": message, "detail": _exact(detail)}}


def _exact(content: Any, name: str = "") -> Any:
    if isinstance(content, Mapping):
        return {str(each): _exact(value, str(each)) for each, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_exact(value, name) for value in content]
    if type(content) is int and name in _KEYS:
        return format_symbol(content)
    return str(content) if type(content) is int and abs(content) > _EXACT else content


def groups(variables: Iterable[Variables]) -> list[dict[str, Any]]:
    """[{kind, keys, values}] of the groups that have values; with stamps where any of a group has one.

    A stamp is text: JavaScript rounds numbers of that many digits.  null: none.
    """
    return [
        {"kind": g.kind, "keys": [format_symbol(key) for key in g.keys.tolist()], "values": g.values.tolist()}
        | ({} if g.stamps is None else {"stamps": [None if t == NO_STAMP else str(t) for t in g.stamps.tolist()]})
        for g in variables
        if g.values is not None
    ]


def estimate(snapshot: Snapshot) -> dict[str, Any]:
    """A whole estimate."""
    return {"epoch": str(snapshot.epoch), "revision": snapshot.revision, "variables": groups(snapshot.variables())}


def plain(report: Mapping[str, Any]) -> dict[str, Any]:
    """What of a step's report is words and numbers that JSON has."""
    return {k: v for k, v in report.items() if isinstance(v, (str, bool, int)) or _is_finite(v)}


def _is_finite(value: Any) -> bool:
    return isinstance(value, float) and math.isfinite(value)
