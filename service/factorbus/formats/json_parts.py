"""A JSON or CBOR file part by part: each knows its place in the file, for what is said of it."""

import json
import math
from typing import Any, NamedTuple

from factorbus.formats.errors import FormatError
from factorbus.wording import counted

_MOST_SHOWN = 40


class Part(NamedTuple):
    """A value of the file, and its place there, such as `measurements.a[3].stamp`; "" for the whole.

    A file has as many as numbers: a frozen dataclass takes three times as long to make.
    """

    file: str
    place: str
    value: Any

    def refused(self, wanted: str, found: str | None = None) -> FormatError:
        """What is wrong with it.  found: in words; else what it is."""
        seen = _shown(self.value) if found is None else found
        return FormatError(self.file, None, f"{self.place}: {seen}" if self.place else seen, wanted)

    def find(self, name: str) -> "Part | None":
        """Its member of that name; None where there is none, or it is null.  Raises FormatError."""
        if not isinstance(self.value, dict):
            raise self.refused("a JSON object")
        found = self.value.get(name)
        return None if found is None else Part(self.file, f"{self.place}.{name}" if self.place else name, found)

    def member(self, name: str) -> "Part":
        """The same, which has to be there.  Raises FormatError."""
        found = self.find(name)
        if found is None:
            raise self.refused(f"an object with {name}", f"no {name}")
        return found

    def members(self) -> dict[str, "Part"]:
        """All its members.  Raises FormatError."""
        if not isinstance(self.value, dict):
            raise self.refused("a JSON object")
        return {name: Part(self.file, f"{self.place}.{abridged(name)}", each) for name, each in self.value.items()}

    def items(self) -> list["Part"]:
        """What is in a list.  Raises FormatError."""
        if not isinstance(self.value, list):
            raise self.refused("a JSON array")
        return [Part(self.file, f"{self.place}[{k}]", each) for k, each in enumerate(self.value)]

    def text(self) -> str:
        """A string.  Raises FormatError."""
        if not isinstance(self.value, str):
            raise self.refused("a string")
        return self.value

    def whole(self, least: int, most: int) -> int:
        """A whole number from `least` to `most`.  Raises FormatError."""
        if type(self.value) is not int or not least <= self.value <= most:
            raise self.refused(f"a whole number from {least} to {most}")
        return self.value

    def number(self) -> float:
        """A finite number.  Raises FormatError."""
        return self._finite([self.value], "a finite number")[0]

    def numbers(self, count: int) -> list[float]:
        """`count` finite numbers.  Raises FormatError."""
        if not isinstance(self.value, list) or len(self.value) != count:
            seen = f"an array of {len(self.value)}" if isinstance(self.value, list) else None
            raise self.refused(f"an array of {counted(count, 'number')}", seen)
        return self._finite(self.value, f"an array of {counted(count, 'finite number')}")

    def _finite(self, values: list[Any], wanted: str) -> list[float]:
        found = []
        for each in values:
            try:
                number = float(each) if type(each) in (int, float) else math.nan
            except OverflowError:  # an integer beyond the range of floats
                number = math.inf
            if not math.isfinite(number):
                raise self.refused(wanted, _shown(each))
            found.append(number)
        return found


def parsed_json(file: str, content: bytes) -> Part:
    """The whole of a JSON file in UTF-8.  Raises FormatError, with the line where it is no JSON."""
    wanted = "JSON in UTF-8, in which each object has a member once"
    try:
        return Part(file, "", json.loads(content.decode(), object_pairs_hook=members_once, parse_constant=_constant))
    except json.JSONDecodeError as error:
        raise FormatError(file, error.lineno, f"no JSON at column {error.colno} ({error.msg})", wanted) from error
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise FormatError(file, line, "bytes that are not UTF-8", wanted) from error
    except RecursionError as error:
        raise FormatError(file, None, "JSON that is nested too deeply", wanted) from error
    except ValueError as error:  # raised below, or a number of more digits than Python reads
        raise FormatError(file, None, abridged(str(error), 80), wanted) from error


def abridged(text: str, most: int = _MOST_SHOWN) -> str:
    """In ASCII, and not longer than fits into a sentence."""
    plain = text.encode("ascii", "backslashreplace").decode()
    return plain if len(plain) <= most else f"{plain[: most - 3]}..."


def _shown(value: Any) -> str:
    return {dict: "an object", list: "an array"}.get(type(value)) or abridged(json.dumps(value))


def members_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of these members.  Raises ValueError where one is there twice."""
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"an object with {next(name for name in names if names.count(name) > 1)} twice")
    return found


def _constant(name: str) -> float:
    raise ValueError(f"{name}, which is no number of JSON")
