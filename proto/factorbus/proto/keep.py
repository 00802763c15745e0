"""What a map keeps of places that are driven through again and again, as text: `per_area=2:1,window=50,landmarks=2`.

per_area    M or M:N: of the poses within M metres of each other N stay (1)
window      how many of the newest poses of each letter stay
landmarks   a pose stays that sees a landmark which no more poses than so see
loss        the most that may be lost for each pose that goes, nats

`all`: everything.
"""

import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from factorbus.proto.problems import BadOption

KEEP_OPTION, KEEP_ALL = "keep", "all"
_WANTED = "all, or per_area=METRES[:POSES] and any of window=N, landmarks=N, loss=NATS, such as per_area=2,window=50"
_NUMBER = re.compile(r"[0-9.eE+-]+")  # Python takes 1_0 and digits of other scripts, too
_MOST = {"poses": 1000, "window": 10**9, "landmarks": 10**9}


class KeepSettings(NamedTuple):
    """per_area_m, poses: how many poses stay within this distance of each other, metres.  window, landmarks, loss: as
    above."""

    per_area_m: float
    poses: int = 1
    window: int = 50
    landmarks: int = 2
    loss: float = 1.0


def try_keep(text: str, where: str = KEEP_OPTION) -> KeepSettings | None:
    """What `text` says; None: everything is kept.  Raises BadOption."""
    if text == KEEP_ALL:
        return None
    given: dict[str, str] = {}
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        if not value or name in given or name not in ("per_area", "window", "landmarks", "loss"):
            raise BadOption(where, f"is {text[:64]!r}, of which {part.strip()[:32]!r} says nothing", _WANTED)
        given[name] = value
    if "per_area" not in given:
        raise BadOption(where, f"is {text[:64]!r}, without per_area", _WANTED)
    area, colon, poses = given["per_area"].partition(":")
    usual = KeepSettings(1.0)
    return KeepSettings(
        _number(where, "per_area", area, 1e-3, 1e6),
        _whole(where, "poses", poses if colon else "1"),
        _whole(where, "window", given.get("window", str(usual.window))),
        _whole(where, "landmarks", given.get("landmarks", str(usual.landmarks))),
        _number(where, "loss", given.get("loss", str(usual.loss)), 0.0, 1e6),
    )


def keep_text(given: str | Mapping[str, Any] | KeepSettings, where: str = KEEP_OPTION) -> str:
    """The same in one form, with every number; given: text, or a mapping such as {"per_area": 2.0, "window": 50}.

    Raises BadOption.
    """
    if not isinstance(given, str | Mapping | KeepSettings):
        raise BadOption(where, f"is {given!r:.64} ({type(given).__name__})", f"{_WANTED}; or a mapping of these")
    if isinstance(given, Mapping):
        area = given.get("per_area")
        if isinstance(area, list | tuple):
            given = {**given, "per_area": ":".join(map(str, area))}
        given = ",".join(f"{name}={value}" for name, value in given.items())
    settings = given if isinstance(given, KeepSettings) else try_keep(given, where)
    if settings is None:
        return KEEP_ALL
    area = f"{_digits(settings.per_area_m)}:{settings.poses}"
    return f"per_area={area},window={settings.window},landmarks={settings.landmarks},loss={_digits(settings.loss)}"


def _digits(number: float) -> str:
    """As short as it may be for the same number to come of it."""
    short = f"{number:g}"
    return short if float(short) == number else repr(float(number))


def _number(where: str, name: str, text: str, least: float, most: float) -> float:
    try:
        value = float(text) + 0.0 if _NUMBER.fullmatch(text) else math.nan  # without a sign, where it is 0
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise BadOption(where, f"has {name}={text[:32]!r}", f"a number from {least:g} to {most:g}")
    return value


def _whole(where: str, name: str, text: str) -> int:
    value = int(text) if text.isascii() and text.isdecimal() and len(text) < 20 else 0
    if not 1 <= value <= _MOST[name]:
        raise BadOption(where, f"has {name}={text[:32]!r}", f"a whole number from 1 to {_MOST[name]}")
    return value
