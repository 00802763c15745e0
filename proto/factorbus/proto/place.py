"""Which number and epoch an insert has that cannot be read otherwise: nothing of it is made but these two."""

from typing import Any

import msgpack

from factorbus.proto.fields import MAX_INTEGER

_NAMES = {b"sequence": 1, b"epoch": 0}  # with the least that each may be
_MOST_FIELDS = 4096


def find_place(data: bytes) -> tuple[int, int] | None:
    """(sequence, epoch) of an insert that is broken somewhere; None where the sequence is not among what can be read.

    The fields before the break count, whatever is in the others: text that is no UTF-8, keys that are no strings,
    nesting without end.  An epoch that is none is 0, as if it were not there.
    """
    found: dict[bytes, int] = {}
    reader = msgpack.Unpacker(raw=True, strict_map_key=False, max_buffer_size=max(len(data), 1))
    try:
        reader.feed(data)
        for _ in range(min(reader.read_map_header(), _MOST_FIELDS)):
            name = _read(reader, data, _is_text)
            value = _read(reader, data, _is_integer) if name in _NAMES else reader.skip()
            if name in _NAMES:
                found[name] = value if value is not None and _NAMES[name] <= value <= MAX_INTEGER else -1
    except (msgpack.exceptions.UnpackException, ValueError, TypeError, OverflowError):
        pass  # as far as it could be read
    sequence, epoch = found.get(b"sequence", -1), found.get(b"epoch", 0)
    return (sequence, max(epoch, 0)) if sequence > 0 else None


def _read(reader: Any, data: bytes, wanted: Any) -> Any:
    """The next value if its first byte is as `wanted`; else it is skipped, and None."""
    at = reader.tell()
    if at < len(data) and wanted(data[at]):
        return reader.unpack()
    return reader.skip()


def _is_text(head: int) -> bool:
    """A string of less than 256 bytes."""
    return head & 0xE0 == 0xA0 or head == 0xD9


def _is_integer(head: int) -> bool:
    return head < 0x80 or head >= 0xE0 or 0xCC <= head <= 0xD3
