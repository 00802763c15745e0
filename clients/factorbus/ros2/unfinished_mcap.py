"""An MCAP file without its end, as a recorder that was killed leaves it: record by record, by the mcap library.

rosbags wants the index at the end of the file.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from factorbus.ros2.recording import Recorded, RecordedTopic, store_of

_DEFINED, _ENCODED = "ros2msg", "cdr"
_HEAD, _MAGIC = struct.Struct("<BQ"), b"\x89MCAP0\r\n"


class NothingWhole(Exception):
    """A file that ends before the first message; where, in words."""


class UnfinishedMcap:
    """The messages in it that are ROS 2's.  Raises what the library does where not even the beginning can be read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        schemas, channels, counts = dict[int, Schema](), dict[int, Channel](), Counter[int]()
        try:
            for record in self._records():
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    counts[record.channel_id] += 1
        except Exception as fault:  # where it ends: what comes before is there
            if not channels and isinstance(fault, EndOfFile | struct.error) and self._is_mcap():
                raise NothingWhole(self._where_it_ends()) from None
            if not channels:
                raise
        self._types = {
            number: (channel.topic, schemas[channel.schema_id].name)
            for number, channel in channels.items()
            if channel.message_encoding == _ENCODED
            and channel.schema_id in schemas
            and schemas[channel.schema_id].encoding == _DEFINED
        }
        self.unread = [channel.topic for number, channel in channels.items() if number not in self._types]
        self.topics = [RecordedTopic(*self._types[number], counts[number]) for number in self._types]
        used = {channels[number].schema_id for number in self._types}
        self._store = store_of([(schemas[each].name, schemas[each].data.decode()) for each in sorted(used)])

    def messages(self, topics: Sequence[str]) -> Iterator[Recorded]:
        """As in `RobotRecording`."""
        for record in self._records():
            if isinstance(record, Message) and record.channel_id in self._types:
                topic, type_name = self._types[record.channel_id]
                if topic in topics:
                    yield Recorded(topic, type_name, record.data)

    def read(self, message: Recorded) -> Any:
        """As in `RobotRecording`."""
        return self._store.deserialize_cdr(message.data, message.type_name)

    def _is_mcap(self) -> bool:
        with self._path.open("rb") as stream:
            return stream.read(len(_MAGIC)) == _MAGIC

    def _where_it_ends(self) -> str:
        """By the opcode and the length that each record begins with."""
        with self._path.open("rb") as stream:
            at, size = len(_MAGIC), self._path.stat().st_size
            while at + _HEAD.size <= size:
                stream.seek(at)
                opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
                at += _HEAD.size + length
                if opcode == Opcode.CHUNK and at > size:
                    return f"{at - size} bytes before its first chunk does"
        return "before its first chunk"

    def _records(self) -> Iterator[Any]:
        with self._path.open("rb") as stream:
            yield from StreamReader(stream).records
