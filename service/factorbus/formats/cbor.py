"""CBOR (RFC 8949), as far as it says what JSON says: JRL's programs write their files in it, too.

    head    three bits of major type, five of an argument: below 24 itself, 24 to 27 that it follows in 1, 2, 4, 8 bytes
    0, 1    the whole numbers n and -1 - n          2, 6    bytes and tags: nothing that JSON has
    3       n bytes of UTF-8                        4, 5    n items, n pairs of a text and an item
    7       20 false, 21 true, 22 null, 25 to 27 floats of 2, 4, 8 bytes

A text, an array or an object of the argument 31 has no length: it ends with the byte 0xff.  Tag 55799 in front of all
says that it is CBOR.  We write lengths, the shortest heads, and floats of 8 bytes.
"""

import struct
from typing import Any

from factorbus.formats.errors import FormatError
from factorbus.formats.json_parts import Part, abridged, members_once

_SELF_DESCRIBED = b"\xd9\xd9\xf7"
_MOST_DEPTH = 64
_OPEN, _BREAK = 31, b"\xff"
_TEXT, _ARRAY, _MAP, _SIMPLE = 3, 4, 5, 7
_DOUBLE = b"\xfb"
_CONSTANTS = {20: False, 21: True, 22: None}
_FLOATS = {25: ">e", 26: ">f", 27: ">d"}
_WANTED = "CBOR that says what JSON says, in which each object has a member once"


class _NoCbor(Exception):
    """at: the byte where it is none."""

    def __init__(self, at: int, why: str) -> None:
        self.at, self.why = at, why
        super().__init__(why)


def is_cbor(content: bytes) -> bool:
    """Whether a file begins as an object in CBOR does, and no text."""
    return content.startswith(_SELF_DESCRIBED) or content[:1] in {bytes([0xA0 + k]) for k in (*range(28), _OPEN)}


def parsed_cbor(file: str, content: bytes) -> Part:
    """The whole of a CBOR file.  Raises FormatError, with the byte where it is none."""
    try:
        value, end = _item(content, len(_SELF_DESCRIBED) if content.startswith(_SELF_DESCRIBED) else 0, 0)
        if end != len(content):
            raise _NoCbor(end, "something behind the end")
    except _NoCbor as error:
        raise FormatError(file, None, f"no CBOR at byte {error.at} ({error.why})", _WANTED) from error
    return Part(file, "", value)


def as_cbor(value: Any) -> bytes:
    """The bytes of what JSON can say: objects, arrays, texts, numbers, true, false and None."""
    out = bytearray()
    _write(out, value)
    return bytes(out)


def _item(content: bytes, at: int, depth: int) -> tuple[Any, int]:
    """An item and where it ends."""
    if depth > _MOST_DEPTH:
        raise _NoCbor(at, "nested too deeply")
    major, argument, end = _head(content, at)
    if major == 0:
        return argument, end
    if major == 1:
        return -1 - argument, end
    if major == _TEXT:
        return _text(content, at, argument, end)
    if major == _ARRAY:
        return _array(content, argument, end, depth)
    if major == _MAP:
        return _object(content, at, argument, end, depth)
    if major == _SIMPLE:
        return _simple(content, at, argument, end)
    raise _NoCbor(at, "bytes or a tag, which JSON does not have")


def _head(content: bytes, at: int) -> tuple[int, int, int]:
    """(major type, argument, where the head ends); of an open length the argument is -1, of a float its kind."""
    if at >= len(content):
        raise _NoCbor(at, "it ends too early")
    major, short = content[at] >> 5, content[at] & 31
    if short < 24 or (major == _SIMPLE and short != 24):
        return major, short, at + 1
    if short == _OPEN and major in (_TEXT, _ARRAY, _MAP):
        return major, -1, at + 1
    if short > 27:
        raise _NoCbor(at, f"a head of {content[at]:#04x}")
    end = at + 1 + (1 << (short - 24))
    if end > len(content):
        raise _NoCbor(at, "it ends too early")
    return major, int.from_bytes(content[at + 1 : end], "big"), end


def _text(content: bytes, at: int, length: int, end: int) -> tuple[str, int]:
    if length < 0:
        pieces = []
        while not content.startswith(_BREAK, end):
            major, length, begin = _head(content, end)
            if major != _TEXT or length < 0:
                raise _NoCbor(end, "a piece of a text that is no text")
            piece, end = _text(content, end, length, begin)
            pieces.append(piece)
        return "".join(pieces), end + 1
    if length > len(content) - end:
        raise _NoCbor(at, "it ends too early")
    try:
        return content[end : end + length].decode(), end + length
    except UnicodeDecodeError as error:
        raise _NoCbor(at, "a text that is not UTF-8") from error


def _array(content: bytes, length: int, end: int, depth: int) -> tuple[list[Any], int]:
    _check_room(content, end, length)
    if length > 0 and content[end : end + 9 * length : 9] == _DOUBLE * length and 9 * length <= len(content) - end:
        return list(struct.unpack_from(f">{length * 'xd'}", content, end)), end + 9 * length  # a row of doubles
    found: list[Any] = []
    while len(found) != length and not (length < 0 and content.startswith(_BREAK, end)):
        value, end = _item(content, end, depth + 1)
        found.append(value)
    return found, end + (length < 0)


def _object(content: bytes, at: int, length: int, end: int, depth: int) -> tuple[dict[str, Any], int]:
    _check_room(content, end, length)
    pairs: list[tuple[str, Any]] = []
    while len(pairs) != length and not (length < 0 and content.startswith(_BREAK, end)):
        name, begin = _item(content, end, depth + 1)
        if not isinstance(name, str):
            raise _NoCbor(end, "an object whose member has a name that is no text")
        value, end = _item(content, begin, depth + 1)
        pairs.append((name, value))
    try:
        return members_once(pairs), end + (length < 0)
    except ValueError as error:
        raise _NoCbor(at, abridged(str(error))) from error


def _simple(content: bytes, at: int, argument: int, end: int) -> tuple[Any, int]:
    if argument in _CONSTANTS:
        return _CONSTANTS[argument], end
    form = _FLOATS.get(argument)
    if form is None:
        raise _NoCbor(at, f"a simple value of {argument}, which JSON does not have")
    if struct.calcsize(form) > len(content) - end:
        raise _NoCbor(at, "it ends too early")
    return struct.unpack_from(form, content, end)[0], end + struct.calcsize(form)


def _check_room(content: bytes, end: int, length: int) -> None:
    """Each item takes a byte at least: what is longer than the file is not looked for."""
    if length > len(content) - end:
        raise _NoCbor(end, "it ends too early")


def _write(out: bytearray, value: Any) -> None:
    if value is None or isinstance(value, bool):
        out.append({False: 0xF4, True: 0xF5, None: 0xF6}[value])
    elif isinstance(value, int):
        _write_head(out, 1 if value < 0 else 0, -1 - value if value < 0 else value)
    elif isinstance(value, float):
        out += _DOUBLE + struct.pack(">d", value)
    elif isinstance(value, str):
        text = value.encode()
        _write_head(out, _TEXT, len(text))
        out += text
    elif isinstance(value, dict):
        _write_head(out, _MAP, len(value))
        for name, each in value.items():
            _write(out, name)
            _write(out, each)
    else:
        _write_head(out, _ARRAY, len(value))
        for each in value:
            _write(out, each)


def _write_head(out: bytearray, major: int, argument: int) -> None:
    if argument < 24:
        out.append(major << 5 | argument)
        return
    size = next(k for k in range(4) if argument < 1 << (8 << k))
    out.append(major << 5 | 24 + size)
    out += argument.to_bytes(1 << size, "big")
