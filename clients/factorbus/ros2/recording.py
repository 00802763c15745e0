"""Recordings of robots: rosbag2 folders and files (SQLite, MCAP) and ROS 1 bags, by rosbags.  No ROS is needed.

Of a recording that was cut off or is damaged what can be read is read, and where that ends is noted.
"""

import re
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

METADATA, OF_ROSBAG2, COMPRESSED = "metadata.yaml", (".mcap", ".db3"), ".zstd"
_OTHER_PROFILE = "Profile is not ros2"  # which rosbags says of a file that another recorder than ROS 2's has written


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
        self.path, self._opened, self._damaged = path, list[str](), dict[str, str]()
        self._stack = ExitStack()
        self._sources: dict[str, _Source] = self._open()
        self._now = next(iter(self._sources.values()))

    @property
    def notes(self) -> list[str]:
        """How it was opened where not as a whole, and where the last reading of it ended before its end."""
        return [*self._opened, *self._damaged.values()]

    @property
    def unread(self) -> list[str]:
        """Topics that nothing is read of, as the form of their messages is not known."""
        return sorted({name for source in self._sources.values() for name in source.unread})

    @property
    def topics(self) -> list[RecordedTopic]:
        """All topics, by name."""
        made: dict[tuple[str, str], int] = {}
        for topic in (each for source in self._sources.values() for each in source.topics):
            made[topic.name, topic.type_name] = made.get((topic.name, topic.type_name), 0) + topic.count
        return sorted((RecordedTopic(*name, count) for name, count in made.items()), key=lambda topic: topic.name)

    def messages(self, topics: Sequence[str]) -> Iterator[Recorded]:
        """Of these topics, in the order in which they were recorded, of each file up to where it is damaged."""
        for name, source in self._sources.items():
            self._now, count = source, 0
            try:
                for message in source.messages(topics):
                    count += 1
                    yield message
            except Exception as fault:  # whatever the file and the libraries that read it make of the damage
                where = f"after {counted(count, 'message')} that are read"
                found = f"cut off or damaged {where} ({_told(fault)}): what comes before is used"
                self._damaged[name] = f"{name} is {found}" if len(self._sources) > 1 else found

    def read(self, message: Recorded) -> Any:
        """The last of `messages` as an object.  Raises whatever the bytes lead to."""
        return self._now.read(message)

    def close(self) -> None:
        """Let go of the file."""
        self._stack.close()

    def __enter__(self) -> "RobotRecording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> dict[str, _Source]:
        """What it is read from, by the names of files."""
        if not self.path.exists():
            raise BadRecording(self.path, "no such file", "a rosbag2 folder, or a .mcap, .db3 or .bag file")
        if self.path.suffix == COMPRESSED:
            wanted = f"its folder, {self.path.parent}, or what `zstd -d` makes of it"
            raise BadRecording(self.path, "a file that ros2 bag has compressed", wanted)
        path = self.path.parent if self.path.name == METADATA else self.path
        if path.is_dir():
            return self._open_folder(path)
        others = files_of(path.parent) if (path.parent / METADATA).is_file() else []
        if path in others and len(others) > 1:
            self._opened.append(f"one of the {len(others)} files of a recording; all of it is {path.parent}")
        return {path.name: self._open_file(path)}

    def _open_folder(self, path: Path) -> dict[str, _Source]:
        """As its metadata.yaml says; where a killed recorder has not written it, or it is not so, the files in it."""
        why = f"no {METADATA}"
        if (path / METADATA).is_file():
            try:
                return {path.name: _Whole(path, self._stack)}
            except Exception as fault:  # whatever the file and the libraries that read it make of the damage
                why = f"it cannot be read as a whole ({_told(fault)})"
        files = files_of(path)
        if not files:
            count = sum(each.suffix in OF_ROSBAG2 for each in path.iterdir())
            wanted = f"{METADATA}, which `ros2 bag reindex` writes, or the files of one recording"
            raise BadRecording(self.path, f"{counted(count, 'file')} and {why}", wanted)
        sources, lost = dict[str, _Source](), list[BadRecording]()
        for file in files:
            try:
                sources[file.name] = self._open_file(file)
            except BadRecording as bad:
                lost.append(bad)
        if not sources:
            raise BadRecording(
                self.path, f"{why}, and of {files[0].name} {lost[0].detail['seen']}", str(lost[0].detail["wanted"])
            )
        self._opened.append(f"{why}: {', '.join(sources)} {'is' if len(sources) == 1 else 'are'} read")
        self._opened += [f"{Path(str(bad.detail['file'])).name} is left out: {bad.detail['seen']}" for bad in lost]
        return sources

    def _open_file(self, path: Path) -> _Source:
        try:
            return _Whole(path, self._stack)
        except Exception as fault:  # whatever the file and the libraries that read it make of the damage
            first = fault
        if path.suffix == ".mcap":
            return self._begun(path, first)
        advice = "reindexed by `rosbag reindex`" if path.suffix == ".bag" else "with its end"
        raise BadRecording(path, f"it cannot be read ({_told(first)})", f"a whole recording, {advice}")

    def _begun(self, path: Path, first: Exception) -> _Source:
        """An MCAP file that cannot be opened as a whole, without its end for example, from its beginning."""
        from factorbus.ros2.unfinished_mcap import NothingWhole, UnfinishedMcap

        try:
            source = UnfinishedMcap(path)
        except NothingWhole as nothing:
            found = f"its {path.stat().st_size} bytes end {nothing}, so no message in it is whole"
            wanted = "more of the file; a recorder writes a chunk when it is full (ros2 bag record: --max-cache-size)"
            raise BadRecording(path, found, wanted) from None
        except Exception as fault:
            raise BadRecording(path, f"it cannot be read ({_told(fault)})", "an MCAP file") from None
        if not source.topics:
            there = f", but {', '.join(sorted(source.unread)[:4])}" if source.unread else f" ({_told(first)})"
            raise BadRecording(path, f"no topic of ROS in it{there}", "a robot's recording")
        if _OTHER_PROFILE not in str(first):
            self._opened.append(f"it has no index that can be read ({_told(first)}): it is read from its beginning")
        return source


def files_of(folder: Path) -> list[Path]:
    """The files of one recording in a folder, in order: one, or name_0, name_1, ...; none where they are of several."""
    files = [each for each in folder.iterdir() if each.suffix in OF_ROSBAG2]
    if len(files) < 2:
        return files
    parts = [(re.fullmatch(r"(.+)_(\d+)", each.stem), each) for each in files]
    numbered = [(int(part[2]), part[1], each) for part, each in parts if part]
    if len(numbered) < len(files) or len({(name, each.suffix) for _, name, each in numbered}) > 1:
        return []
    return [each for _, _, each in sorted(numbered)]


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
