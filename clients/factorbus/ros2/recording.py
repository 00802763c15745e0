"""Recordings of robots: rosbag2 folders and files (SQLite, MCAP) and ROS 1 bags, by rosbags.  No ROS is needed.

Of a recording that was cut off or is damaged what can be read is read, and where that ends is noted.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from factorbus.ros2.messages import DISTRIBUTIONS, register_further_types
from factorbus.ros2.problems import BadRecording
from factorbus.wording import counted

_LATEST = DISTRIBUTIONS["jazzy"]  # of recordings that do not say what their messages are made of


METADATA, OF_ROSBAG2 = "metadata.yaml", (".mcap", ".db3")


class Recorded(NamedTuple):
    """One message, as it was recorded."""

    topic: str
    type_name: str
    data: bytes


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """What a recording has of a topic; count 0: it does not say how many."""

    name: str
    type_name: str
    count: int


class _Source(Protocol):
    topics: list[RecordedTopic]
    unread: list[str]

    def messages(self, topics: Sequence[str]) -> Iterator[Recorded]:
        """Of these topics, in the order in which they were recorded."""
        ...

    def read(self, message: Recorded) -> Any:
        """As an object."""
        ...


class RobotRecording:
    """A recording that is open, until `close`.

    Raises BadRecording: it is none, or nothing of it can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._opened, self._damaged = path, "", ""
        self._stack = ExitStack()
        self._source: _Source = self._open()

    @property
    def notes(self) -> list[str]:
        """How it was opened where not as a whole, and where the last reading of it ended before its end."""
        return [note for note in (self._opened, self._damaged) if note]

    @property
    def unread(self) -> list[str]:
        """Topics that nothing is read of, as the form of their messages is not known."""
        return sorted(self._source.unread)

    @property
    def topics(self) -> list[RecordedTopic]:
        """All topics, by name."""
        return sorted(self._source.topics, key=lambda topic: topic.name)

    def messages(self, topics: Sequence[str]) -> Iterator[Recorded]:
        """Of these topics, in the order in which they were recorded, up to where it is damaged."""
        count = 0
        try:
            for message in self._source.messages(topics):
                count += 1
                yield message
        except Exception as fault:  # whatever the file and the libraries that read it make of the damage
            where = f"after {counted(count, 'message')} that are read"
            self._damaged = f"cut off or damaged {where} ({_told(fault)}): what comes before is used"

    def read(self, message: Recorded) -> Any:
        """As an object.  Raises whatever the bytes lead to."""
        return self._source.read(message)

    def close(self) -> None:
        """Let go of the file."""
        self._stack.close()

    def __enter__(self) -> "RobotRecording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> _Source:
        if not self.path.exists():
            raise BadRecording(self.path, "no such file", "a rosbag2 folder, or a .mcap, .db3 or .bag file")
        path = self._file_of_folder() if self.path.is_dir() else self.path
        try:
            return _Whole(path, self._stack)
        except Exception as fault:  # whatever the file and the libraries that read it make of the damage
            first = fault
        if path.suffix == ".mcap":
            return self._begun(path, first)
        advice = "reindexed by `rosbag reindex`" if path.suffix == ".bag" else "with its end"
        raise BadRecording(self.path, f"it cannot be read ({_told(first)})", f"a whole recording, {advice}")

    def _file_of_folder(self) -> Path:
        """The folder, or the one file in it where a recorder that was killed has not written metadata.yaml."""
        if (self.path / METADATA).is_file():
            return self.path
        files = sorted(each for each in self.path.iterdir() if each.suffix in OF_ROSBAG2)
        if len(files) != 1:
            wanted = f"{METADATA}, which `ros2 bag reindex` writes, or one file"
            raise BadRecording(self.path, f"{counted(len(files), 'file')} and no {METADATA}", wanted)
        self._opened = f"no {METADATA}: {files[0].name} is read"
        return files[0]

    def _begun(self, path: Path, first: Exception) -> _Source:
        """An MCAP file that cannot be opened as a whole, without its end for example, from its beginning."""
        from factorbus.ros2.unfinished_mcap import NothingWhole, UnfinishedMcap

        try:
            source = UnfinishedMcap(path)
        except NothingWhole as nothing:
            found = f"its {path.stat().st_size} bytes end {nothing}, so no message in it is whole"
            wanted = "more of the file; a recorder writes a chunk when it is full (ros2 bag record: --max-cache-size)"
            raise BadRecording(self.path, found, wanted) from None
        except Exception as fault:
            raise BadRecording(self.path, f"it cannot be read ({_told(fault)})", "an MCAP file") from None
        if not source.topics:
            raise BadRecording(self.path, f"no topic of ROS in it ({_told(first)})", "a robot's recording")
        self._opened = f"it has no index that can be read ({_told(first)}): it is read from its beginning"
        return source


class _Whole:
    """What rosbags can open."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        store = get_typestore(_LATEST)
        register_further_types(store)
        self._reader = stack.enter_context(AnyReader([path], default_typestore=store))
        self.topics = [
            RecordedTopic(name, info.msgtype or "", info.msgcount)
            for name, info in self._reader.topics.items()
            if info.msgtype
        ]
        self.unread = [name for name, info in self._reader.topics.items() if not info.msgtype]

    def messages(self, topics: Sequence[str]) -> Iterator[Recorded]:
        """As in `RobotRecording`."""
        chosen = [each for each in self._reader.connections if each.topic in topics]
        if chosen:
            for connection, _, data in self._reader.messages(chosen):
                yield Recorded(connection.topic, connection.msgtype, data)

    def read(self, message: Recorded) -> Any:
        """As in `RobotRecording`."""
        return self._reader.deserialize(message.data, message.type_name)


def store_of(definitions: Sequence[tuple[str, str]]) -> Any:
    """Types by their definitions (name, text), as recordings have them."""
    store, types = get_typestore(Stores.EMPTY), {}
    for name, text in definitions:
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def _told(fault: Exception) -> str:
    return f"{type(fault).__name__}: {fault}".splitlines()[0][:120]
