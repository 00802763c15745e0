"""An MCAP file record by record, by the mcap library: one without its end, as a recorder that was killed leaves it, or
with messages of ROS 1, as a bag that was converted has them.

rosbags wants ROS 2, and the index at the end of the file.  Of a chunk that is cut off the records up to there are read:
it is compressed as a stream, of which every block that is whole can be unpacked.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Message, Schema
from mcap.stream_reader import StreamReader

from factorbus.ros2.recording import Recorded, RecordedTopic, store_of

# How messages are encoded, and what their definitions are written in.
_DEFINED = {"cdr": "ros2msg", "ros1": "ros1msg"}
_HEAD, _MAGIC = struct.Struct("<BQ"), b"\x89MCAP0\r\n"
_BEFORE_COMPRESSION, _AFTER_IT = 28, 8  # bytes of a chunk: two times, a size and a checksum; the size of what follows


class NothingWhole(Exception):
    """A file that ends before the first message; where, in words."""


class UnfinishedMcap:
    """The messages in it that are of ROS.  Raises what the library does where not even the beginning can be read."""

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
        of_ros = {
            number: channel
            for number, channel in channels.items()
            if channel.schema_id in schemas
            and _DEFINED.get(channel.message_encoding) == schemas[channel.schema_id].encoding
        }
        self._types = {n: (each.topic, _full(schemas[each.schema_id].name)) for n, each in of_ros.items()}
        self._encodings = {self._types[n]: each.message_encoding for n, each in of_ros.items()}
        self.unread = [channel.topic for number, channel in channels.items() if number not in self._types]
        self.topics = [RecordedTopic(*self._types[number], counts[number]) for number in self._types]
        self._stores = {
            encoding: store_of([(_full(schemas[each].name), schemas[each].data.decode()) for each in sorted(used)])
            for encoding in _DEFINED
            if (used := {each.schema_id for each in of_ros.values() if each.message_encoding == encoding})
        }

    def messages(self, topics: Sequence[str]) -> Iterator[Recorded]:
        """As in `RobotRecording`."""
        for record in self._records():
            if isinstance(record, Message) and record.channel_id in self._types:
                topic, type_name = self._types[record.channel_id]
                if topic in topics:
                    yield Recorded(topic, type_name, record.data)

    def read(self, message: Recorded) -> Any:
        """As in `RobotRecording`."""
        encoding = self._encodings[message.topic, message.type_name]
        store = self._stores[encoding]
        if encoding == "ros1":
            return store.deserialize_ros1(message.data, message.type_name)
        return store.deserialize_cdr(message.data, message.type_name)

    def _is_mcap(self) -> bool:
        with self._path.open("rb") as stream:
            return stream.read(len(_MAGIC)) == _MAGIC

    def _where_it_ends(self) -> str:
        cut = self._cut_record()
        if cut is None or not cut.is_chunk:
            return "before its first chunk"
        return f"{cut.missing_bytes} bytes before its first chunk does"

    def _records(self) -> Iterator[Any]:
        """Raises what the library does where they end."""
        cut = self._cut_record()
        with self._path.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
                    if cut is not None and stream.tell() > cut.at:
                        break  # the library makes one of whatever there is
                    if isinstance(record, Footer):
                        return
                    yield record
            except Exception:
                if cut is None or stream.tell() <= cut.at:
                    raise
            if cut is not None and cut.is_chunk:
                stream.seek(cut.at + _HEAD.size)
                yield from StreamReader(BytesIO(_whole_records(stream.read())), skip_magic=True).records
            raise EndOfFile()

    def _cut_record(self) -> "_CutRecord | None":
        """The last one where it is not whole, by the opcode and the length that each begins with."""
        with self._path.open("rb") as stream:
            at, size = len(_MAGIC), self._path.stat().st_size
            while at + _HEAD.size <= size:
                stream.seek(at)
                opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
                begin, at = at, at + _HEAD.size + length
                if at > size:
                    return _CutRecord(begin, opcode == Opcode.CHUNK, at - size)
        return None


def _full(name: str) -> str:
    """nav_msgs/msg/Odometry of nav_msgs/Odometry, as ROS 1 has it."""
    package, _, kind = name.partition("/")
    return name if "/" in kind else f"{package}/msg/{kind}"


class _CutRecord(NamedTuple):
    """Where it begins, and how many of its bytes are not there."""

    at: int
    is_chunk: bool
    missing_bytes: int


def _whole_records(cut: bytes) -> bytes:
    """Those of a chunk as far as its bytes go."""
    stream = ReadDataStream(BytesIO(cut))
    stream.read(_BEFORE_COMPRESSION)
    compression = stream.read_prefixed_string()
    data = cut[stream.count + _AFTER_IT :]
    if compression == "zstd":
        data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    elif compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data)
    at = end = 0
    while end <= len(data):
        at = end
        if at + _HEAD.size > len(data):
            break
        end = at + _HEAD.size + _HEAD.unpack_from(data, at)[1]
    return data[:at]
