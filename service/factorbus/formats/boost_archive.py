"""Read a binary archive of Boost.Serialization, in which C++ programs such as GTSAM's keep their objects.

A header; then values one after the other, as a 64-bit little-endian machine has them, without names or lengths.  An
object is preceded, the first of its class, by whether the class is tracked (1 byte) and its version (4); where it is
tracked, by its number (4), after which nothing follows if an object of that number has been read.  A pointer has the
number of its class before that (2, −1 for none), and of a class that is not known yet its name.  Classes are numbered
in the order in which they first occur, also those of which nothing is said.  So what has a class that is not known here
ends the reading: nothing says how long it is.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorbus.proto.arrays import F64, I64

Read = Callable[[int], Any]  # the members of an object of that version of its class

_SIGNATURE = b"serialization::archive"
_LEAST_VERSION, _MOST_VERSION = 9, 30  # of the library, whose binary archives are of the form above
_SIZES = bytes((4, 8, 4, 8)) + struct.pack("<i", 1)  # of int, long, float and double; and the order of bytes
_LONGEST_NAME = 256
_DEEPEST = 64  # objects within objects


class UnreadableArchive(Exception):
    """What comes next cannot be read: it is damaged, or of a class that is not known here."""


@dataclass(frozen=True, slots=True)
class _Class:
    """What the archive says of a class: whether its objects are numbered, and the version of their form."""

    tracked: bool
    version: int


class BoostArchive:
    """A binary archive that is read from its beginning.  All raise UnreadableArchive."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0
        self._names: list[str] = []  # of the classes, by number
        self._classes: dict[str, _Class] = {}  # those whose first object has been read
        self._objects: list[tuple[str, Any]] = []  # by number: of which class, and what it is
        self._depth = 0
        self._read_header()

    def _read_header(self) -> None:
        if self.whole() != len(_SIGNATURE) or self._take(len(_SIGNATURE)) != _SIGNATURE:
            raise UnreadableArchive("it does not begin as an archive")
        version = self._number("<H")
        if not _LEAST_VERSION <= version <= _MOST_VERSION or self._take(len(_SIZES)) != _SIZES:
            raise UnreadableArchive(f"its form is not that of version {version} on a 64-bit little-endian machine")

    @property
    def left(self) -> int:
        """How many bytes have not been read."""
        return len(self._content) - self._at

    def flag(self) -> bool:
        byte = self._number("<B")
        if byte > 1:
            raise UnreadableArchive(f"byte {self._at - 1} is {byte}, where 0 or 1 was expected")
        return bool(byte)

    def int32(self) -> int:
        return self._number("<i")

    def whole(self) -> int:
        """A size."""
        return self._number("<Q")

    def real(self) -> float:
        return self._number("<d")

    def reals(self, count: int) -> F64:
        return np.frombuffer(self._take(8 * count), "<f8").astype(np.float64)

    def wholes(self, name: str) -> I64:
        """A vector of 64-bit integers, a class of which nothing is said unless it has an allocator of its own."""
        if self.next_whole() > self.left // 8:  # then the two things that are said of a class come first
            return self.object(name, lambda _: self._wholes())
        self._registered(name)
        return self._wholes()

    def next_whole(self) -> int:
        """The size that is read next, or would be."""
        at = self._at
        value, self._at = self.whole(), at
        return value

    def object(self, name: str, read: Read) -> Any:
        """An object of the class `name`."""
        self._registered(name)
        return self._content_of(name, read)

    def pointer(self, reads: Mapping[str, Read], declared: str = "") -> Any:
        """What a pointer points at, None for nothing.

        reads: how to read it, by the name of its class   declared: class of the pointer, unless that is abstract
        """
        if declared:
            self._registered(declared)
        number = self._number("<h")
        if number == -1:
            return None
        if number == len(self._names):
            self._names.append(self._name())
        if not 0 <= number < len(self._names):
            raise UnreadableArchive(f"class {number} at byte {self._at - 2}, of {len(self._names)} that there are")
        name = self._names[number]
        if name not in reads:
            raise UnreadableArchive(f"a {name}, whose form is not known here")
        return self._content_of(name, reads[name])

    def _registered(self, name: str) -> None:
        if name not in self._names:
            self._names.append(name)

    def _content_of(self, name: str, read: Read) -> Any:
        about = self._classes.get(name)
        if about is None:
            about = self._classes[name] = _Class(self.flag(), self._number("<I"))
        if not about.tracked:
            return self._members(read, about.version)
        number = self._number("<I")
        if number > len(self._objects) or (number < len(self._objects) and self._objects[number][0] != name):
            raise UnreadableArchive(f"object {number} of {len(self._objects)} as a {name}")
        if number < len(self._objects):
            return self._objects[number][1]
        self._objects.append(("", None))  # no class, until it has been read: it cannot be a part of itself
        self._objects[number] = (name, self._members(read, about.version))
        return self._objects[number][1]

    def _members(self, read: Read, version: int) -> Any:
        if self._depth >= _DEEPEST:
            raise UnreadableArchive(f"more than {_DEEPEST} objects within each other")
        self._depth += 1
        members = read(version)
        self._depth -= 1
        return members

    def _wholes(self) -> I64:
        count = self.whole()
        return np.frombuffer(self._take(8 * count), "<i8").astype(np.int64)

    def _name(self) -> str:
        length = self.whole()
        if length > _LONGEST_NAME:
            raise UnreadableArchive(f"the name of a class of {length} characters")
        return self._take(length).decode("ascii", "backslashreplace")

    def _number(self, form: str) -> Any:
        return struct.unpack(form, self._take(struct.calcsize(form)))[0]

    def _take(self, count: int) -> bytes:
        if count > self.left:
            raise UnreadableArchive("it ends before its time")
        self._at += count
        return self._content[self._at - count : self._at]
